"""The artifact store: results of stages, written completely or not at all, and named by their inputs."""

from stages.shared.artifacts.artifact import Artifact
from stages.shared.artifacts.build import Build
from stages.shared.artifacts.external import ExternalFiles
from stages.shared.artifacts.files import require_room, whole_folder, write_whole
from stages.shared.artifacts.progress import Progress
from stages.shared.artifacts.spec import StageResult, StageSpec
from stages.shared.artifacts.workspace import Inputs, Workspace

__all__ = [
    "Artifact",
    "Build",
    "ExternalFiles",
    "Inputs",
    "Progress",
    "StageResult",
    "StageSpec",
    "Workspace",
    "require_room",
    "whole_folder",
    "write_whole",
]
