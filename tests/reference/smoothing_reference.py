"""Slow reference implementation of the smoother: one dense least-squares problem for all positions and velocities."""

import numpy as np

ANYWHERE, VELOCITY = 1e4, 5.0


def smooth_joints_reference(
    times: np.ndarray, joints: np.ndarray, precision: np.ndarray, process_noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The path (T, J, 3) and its variance (T, J): see `motion_model.smooth_joints`."""
    frames, count, _ = joints.shape
    path, variance = np.empty(joints.shape), np.empty((frames, count))
    for j in range(count):
        # unknowns: position and velocity of each frame
        information = np.zeros((2 * frames, 2 * frames))
        right = np.zeros((2 * frames, 3))
        information[:2, :2] += np.diag([1 / ANYWHERE, 1 / VELOCITY**2])
        for t in range(frames):
            information[2 * t, 2 * t] += precision[t, j]
            right[2 * t] = precision[t, j] * joints[t, j]
            if t:
                step = times[t] - times[t - 1]
                noise = process_noise[t, j] * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
                # state of the frame minus its prediction from the previous frame
                jump = np.hstack([-np.array([[1, step], [0, 1]]), np.eye(2)])
                information[2 * t - 2 : 2 * t + 2, 2 * t - 2 : 2 * t + 2] += jump.T @ np.linalg.inv(noise) @ jump
        covariance = np.linalg.inv(information)
        path[:, j] = (covariance @ right)[::2]
        variance[:, j] = np.diag(covariance)[::2]
    return path, variance
