"""Pose files of other programs, read into `Poses`: AMASS, SMPL-X, `smpl_params.npz`, BVH."""

from stages.shared.poses.read import load_poses

__all__ = ["load_poses"]
