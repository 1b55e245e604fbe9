"""How noisy the filter of `deploy.ekf` takes its model and its readings to be."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NoiseCfg:
    """Standard deviations, all of them of one axis.

    Those of readings are the simulated sensors'. Walks of the biases are half as large again as theirs, and
    those of the feet were chosen so that the errors are as large as the filter says (docs/estimator.md).

    Attributes:
        gyro: of a reading [rad/s].
        acc: of a reading [m/s^2].
        scale: of a reading, relative to what it reads beyond rest: coning, timing, scale factors.
        sample: of what a shock does unseen between two accelerometer readings, relative to their difference
            beyond that of noise.
        gyro_walk: of the gyroscope's bias [rad/s/sqrt(s)].
        acc_walk: of the accelerometer's bias [m/s^2/sqrt(s)].
        gyro_bias: of the gyroscope's bias before the first reading [rad/s].
        acc_bias: of the accelerometer's, likewise [m/s^2].
        turn: of the angular acceleration that a gap between readings hides [rad/s^2].
        jerk: of the change of acceleration that it hides [m/s^3].
        foot: of a standing foot's random walk [m/sqrt(s)], while its leg sways: yielding ground.
        firm: of that of a leg that is still [m/sqrt(s)]: what its creep has besides one number for all feet.
        roll: of the walk that comes with the shank's turning [m/sqrt(rad)]: wrong links and joint zeros,
            feet that are not quite spheres.
        slide: of the walk that comes with creep, relative to its speed [sqrt(s)].
        across: of the force across a leg that makes its foot creep, where the torques tell nothing of it, as
            white noise [N sqrt(s)]: 13 N in a foot stand.
        creep: of a foot's creep before the first reading [m/s/N].
        late: of how late the gyroscope reads [s].
        creep_walk: of its random walk, per square root of a second.
        kinematics: of a foot's place by kinematics, while its leg sways [m]: wrong links and zeros err anew
            in each posture.
        encoder: of that of a leg that is still, or all but still [m]: an encoder's step is 0.06 mm at a foot,
            its error 0.015 mm along an axis, but the same for some readings.
        sway: angle that a leg has turned lately from which on it sways as much as any [rad]; below it, as its
            square.
        sway_time: what is lately [s].
        calm_time: in which swaying that is over goes down to 1/e [s].
        ground: of the ground's height at a foothold [m].
        ground_time: for how long its errors stay the same [s].
    """

    gyro: float = 0.01
    acc: float = 0.1
    scale: float = 0.01
    sample: float = 0.15
    gyro_walk: float = 1.5e-4
    acc_walk: float = 1.5e-3
    gyro_bias: float = 0.003
    acc_bias: float = 0.03
    turn: float = 20.0
    jerk: float = 100.0
    foot: float = 0.0002
    firm: float = 0.000065
    roll: float = 0.0004
    slide: float = 0.01
    across: float = 2.2
    creep: float = 1e-3
    late: float = 1e-3
    creep_walk: float = 3e-4
    kinematics: float = 0.0008
    encoder: float = 0.00002
    sway: float = 0.01
    sway_time: float = 0.1
    calm_time: float = 0.3
    ground: float = 0.01
    ground_time: float = 1.0
