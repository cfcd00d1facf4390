"""Settings of `python -m tests.benchmarks.templates`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BenchTemplatesConfig:
    """What is measured.

    Attributes:
        preset: of the stages that are run.
        fit: also fit the body to the first scan without given parameters.
        camera_step: every so many-th training camera of the test takes.
        frame_step: every so many-th test frame that was filmed.
    """

    preset: str = "draft"
    fit: bool = True
    camera_step: int = 1
    frame_step: int = 1


@dataclass(frozen=True)
class Bar:
    """What a row must reach: at most (`kind` "max") or at least ("min") `value`; None: only reported."""

    kind: str
    value: float | None

    def met(self, measured: float | None) -> bool | None:
        """Whether it is; None when nothing was measured or nothing is asked."""
        if measured is None or self.value is None:
            return None
        return measured <= self.value if self.kind == "max" else measured >= self.value


BARS: dict[str, Bar] = {
    # Names of rows without what follows their dot.
    "fit_scan_joint_error_mm": Bar("max", 15.0),
    "fit_scan_shape_error_mm": Bar("max", 5.0),
    "fit_images_joint_error_mm": Bar("max", 25.0),
    "pose_back_max_m": Bar("max", 1e-5),
    "pose_back_requeried_p95_m": Bar("max", 3e-3),
    "shape_transfer_max_m": Bar("max", 1e-5),
    "label_accuracy": Bar("min", 0.97),
    "label_miou": Bar("min", 0.93),
    "unseen_area": Bar("max", 0.01),
    "windows_of_full_maps": Bar("max", 0.45),
    "skinned_iou": Bar("min", 0.93),
    "stretch": Bar("max", 3.0),
    "other_stretch": Bar("max", None),
    "stage_seconds": Bar("max", 60.0),
    "stage_peak_bytes": Bar("max", 2e9),
}
