"""Detects people in whole scans: ground, positions where a person may stand, and the network that scores them.

Legend of this package: n points of a scan, K candidates. Level frame: z up, m.
"""
