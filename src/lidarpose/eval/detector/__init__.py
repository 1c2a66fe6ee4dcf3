"""Evaluation of a people detector on labeled scans: `lidarpose evaluate detector`."""
