"""How noisy the filter of `deploy.ekf` takes its model and its readings to be."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NoiseCfg:
    """Standard deviations, all of them of one axis.

    Those of readings are the simulated sensors', the accelerometer's somewhat less; walks of the biases are
    half as large again as theirs. These and those of the feet were chosen so that the errors are as large as
    the filter says (docs/estimator.md).

    Attributes:
        gyro: of a reading [rad/s].
        acc: of a reading [m/s^2].
        scale: of a reading of the gyroscope, relative to what it reads: coning, timing, scale factors.
        acc_scale: of one of the accelerometer, relative to what it reads beyond rest.
        sample: of what a shock does unseen between two accelerometer readings, relative to their difference
            beyond `shock`.
        shock: difference of two readings up to which motion is smooth: what one hides, the next tells
            [m/s^2].
        gyro_walk: of the gyroscope's bias [rad/s/sqrt(s)].
        acc_walk: of the accelerometer's bias [m/s^2/sqrt(s)].
        gyro_bias: of the gyroscope's bias before the first reading [rad/s].
        acc_bias: of the accelerometer's, likewise [m/s^2].
        turn: of the angular acceleration that a gap between readings hides [rad/s^2].
        jerk: of the change of acceleration that it hides [m/s^3].
        foot: of a standing foot's random walk [m/sqrt(s)].
        bend: of the walk that comes with the shank's turning since touchdown [m/rad]: wrong links and joint
            zeros, feet that are not quite spheres.
        late: of how late the gyroscope reads [s].
        kinematics: of a foot's place by kinematics, while its leg sways [m]: wrong links and zeros err anew
            in each posture.
        swing: of that by how far its leg, or the body, has turned lately [m/rad].
        encoder: of that of a leg that is still, or all but still [m]: a step of 15 bits is 0.06 mm at a foot,
            its error 0.015 mm along an axis, but the same for some readings.
        give: of a foot's compliance before the first reading [m/N].
        give_walk: of its random walk [m/N/sqrt(s)].
        spin: of the rate at which the feet of a body that sways slide round it [rad/s].
        spin_time: for how long that stays the same [s].
        sway: angle that a leg has turned lately from which on it sways as much as any [rad]; below it, as its
            square.
        sway_time: what is lately [s].
        calm_time: in which swaying that is over goes down to 1/e [s].
        rise: of the walk of body and feet together, up and down, for which there is no reading [m/sqrt(s)].
        ground: of the ground's height at a foothold [m].
        ground_time: for how long its errors stay the same [s].
    """

    gyro: float = 0.01
    acc: float = 0.086
    scale: float = 0.01
    acc_scale: float = 0.005
    sample: float = 0.15
    shock: float = 5.0
    gyro_walk: float = 1.5e-4
    acc_walk: float = 1.5e-3
    gyro_bias: float = 0.003
    acc_bias: float = 0.03
    turn: float = 10.0
    jerk: float = 20.0
    foot: float = 0.00004
    bend: float = 0.002
    late: float = 1e-3
    kinematics: float = 0.00025
    swing: float = 0.0035
    encoder: float = 0.00002
    give: float = 2e-5
    give_walk: float = 1e-6
    spin: float = 0.003
    spin_time: float = 1000.0
    sway: float = 0.01
    sway_time: float = 0.1
    calm_time: float = 0.3
    rise: float = 0.0015
    ground: float = 0.01
    ground_time: float = 1.0
