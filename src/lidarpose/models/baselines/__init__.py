"""The networks that the paper compares with, built to their published layer sizes.

Legend of this package: B people or clips, T frames of a clip, N points, J joints, C channels.
"""
