"""People found in whole scans against labeled ones: `lidarpose evaluate detector`."""
