"""`gw poses`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_poses
from gw_cli.options import DryRun, Json, one_of


def register(app: typer.Typer) -> None:
    @app.command("poses")
    @command
    def poses(
        source: Annotated[
            Path, typer.Argument(metavar="FILE", help="smpl_params.npz, AMASS, EasyMocap, or BVH.")
        ],
        output: Annotated[Path, typer.Option("-o", "--output", help="The smpl_params.npz to write.")],
        fps: Annotated[
            float, typer.Option(min=0, help="Resample to this frame rate; 0 keeps the file's own.")
        ] = 0.0,
        up: Annotated[
            str,
            typer.Option(
                help="Axis of FILE that points up: x, y, z, -x, -y or -z; auto: z for AMASS, the rest pose's "
                "for BVH, else y."
            ),
        ] = "auto",
        file_fps: Annotated[
            float, typer.Option(min=0, help="Frame rate of FILE, where it states none or a wrong one.")
        ] = 0.0,
        length_unit: Annotated[str, typer.Option(help="Unit of FILE's translation: m, cm, mm.")] = "m",
        degrees: Annotated[bool, typer.Option("--degrees", help="FILE's angles are degrees.")] = False,
        hands: Annotated[
            str, typer.Option(help="file, flat (stretched), or relaxed (the body model's mean hand).")
        ] = "file",
        frames: Annotated[
            str, typer.Option(metavar="START:END:STEP", help="Of the result; default all.")
        ] = "",
        correct_amass: Annotated[
            bool,
            typer.Option(
                help="Raise collars, still the head's nod, straighten wrists, as is usual for AMASS."
            ),
        ] = False,
        body_model: Annotated[
            Path | None, typer.Option(metavar="FILE", help="SMPL-X model; default: the embedded body.")
        ] = None,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Turn a motion of any known kind into one that every command reads: y up, metres, 55 joints.

        The content of FILE decides of what kind it is. All commands with --poses read such files directly.
        This command is for files that state too little (the up axis, the hands), and for cutting.

        Example: gw poses walk_poses.npz -o walk.npz --fps 30 --correct-amass
        """
        check_poses([source])
        console = Console(as_json)
        console.loading()

        from stages.shared.body import embedded_body
        from stages.shared.body.load import load_body
        from stages.shared.outfit.sources import parse_frames
        from stages.shared.plan import Plan
        from stages.shared.poses.convert import amass_corrected, with_hands
        from stages.shared.poses.pose_arrays import METRES_PER_UNIT, PoseUnits
        from stages.shared.poses.read import load_poses
        from stages.shared.targets import check_file_target

        check_file_target(output, "-o walk.npz")
        body = load_body(body_model) if body_model else embedded_body()
        one_of("--length-unit", length_unit, tuple(METRES_PER_UNIT), "unit of length")
        units = PoseUnits(degrees, METRES_PER_UNIT[length_unit], file_fps or None)
        motion = load_poses(source, body, fps or None, up, units, report=console)
        motion = with_hands(amass_corrected(motion) if correct_amass else motion, hands, body)
        motion = motion[parse_frames(frames, len(motion))]
        seconds = (len(motion) - 1) / motion.fps
        facts = {"frames": len(motion), "fps": motion.fps, "motion_seconds": round(seconds, 3)}
        if dry_run:
            console.plan(Plan([str(source)], [str(output)], facts, disk_bytes=700 * len(motion)))
            return
        motion.save(output)
        console.result({"path": output, **facts})
