"""What the estimator knows at a tick, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy.ekf import BW, PHI, Flags, V
from deploy.kinematics import IMU
from deploy.so3 import Array, skew


@dataclass(frozen=True, slots=True)
class Estimate:
    """State of the body, its biases and its contacts; the arrays are the receiver's own.

    Attributes:
        t: time of the readings, by the robot's clock [s].
        x: state in MuJoCo's convention, (37,): base position [m], quaternion (w, x, y, z), joint angles
            [rad], base velocity in the world frame [m/s], angular velocity in the body frame [rad/s], joint
            speeds [rad/s].
        C: attitude as a matrix, body to world, (3, 3).
        gyro_bias: [rad/s], (3,).
        acc_bias: [m/s^2], (3,).
        contact: feet that carry load, (4,) bool.
        used: feet that this tick's update used, (4,) bool.
        P: covariance of the filter's error, see `deploy.ekf`, (30, 30).
        gyro_noise: standard deviation of the angular velocity's noise [rad/s].
    """

    t: float
    x: Array
    C: Array
    gyro_bias: Array
    acc_bias: Array
    contact: Flags
    used: Flags
    P: Array
    gyro_noise: float

    @property
    def position(self) -> Array:
        """Of the base in the world frame [m], (3,)."""
        return self.x[:3]

    @property
    def quaternion(self) -> Array:
        """Attitude (w, x, y, z), body to world, (4,)."""
        return self.x[3:7]

    @property
    def velocity(self) -> Array:
        """Of the base in the world frame [m/s], (3,)."""
        return self.x[19:22]

    @property
    def velocity_body(self) -> Array:
        """Of the base in the body frame [m/s], (3,)."""
        return self.velocity @ self.C

    @property
    def omega(self) -> Array:
        """Angular velocity in the body frame, without the bias [rad/s], (3,)."""
        return self.x[22:25]

    @property
    def gravity(self) -> Array:
        """Direction of gravity in the body frame, a unit vector, (3,)."""
        return -self.C[2]

    def velocity_covariance(self) -> Array:
        r"""Of the error of `velocity_body` [m^2/s^2], (3, 3).

        With the IMU at a, :math:`v_B = C^T v - (w_m - b_w) \times a`.
        """
        J = np.zeros((3, len(self.P)))
        imu = self.velocity + self.C @ (skew(self.omega) @ IMU)
        J[:, PHI], J[:, V], J[:, BW] = self.C.T @ skew(imu), self.C.T, -skew(IMU)
        arm = skew(self.gyro_noise * IMU)
        return J @ self.P @ J.T + arm @ arm.T

    def tilt_covariance(self) -> Array:
        """Of the attitude error's horizontal components in the world frame [rad^2], (2, 2)."""
        return self.P[:2, :2]
