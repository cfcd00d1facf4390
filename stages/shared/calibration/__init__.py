"""Calibrations as other tools write them: distorted cameras in any unit and any orientation of the world."""
