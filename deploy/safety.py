"""What the robot may do: the phases from passive to damping, the envelopes of each, limits of commands.

Nothing here reads a clock or a wire: the same inputs give the same answers.

======== ============================ ===================== =============== ==============
phase    the robot                    START                 SELECT          a fault, L2+B
======== ============================ ===================== =============== ==============
passive  is not commanded             lie                   -               - (L2+B: damping)
lie      folds its legs, lies         stand, once it lies   damping         damping
stand    rises on four legs, then     -                     lie             damping
         goes on to ready by itself
ready    stands on four legs          hybrid, if planned    lie             damping
                                      and in its pose
hybrid   runs the modes of the plan   asks for the          damping         damping
                                      handstand
damping  resists motion, for good     -                     -               -
======== ============================ ===================== =============== ==============
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from deploy.observe import lean, pitch
from deploy.remote import Button
from deploy.settings import EnvelopeCfg
from deploy.so3 import Array
from hmc.go2 import facts
from hmc.go2.network import LOWER, UPPER

NOTHING, EMERGENCY = Button(0), Button.L2 | Button.B
PEAK_TORQUE = facts.PEAK * np.array(facts.GEAR)


class Phase(IntEnum):
    """Phases of the state machine."""

    PASSIVE = 0
    LIE = 1
    STAND = 2
    READY = 3
    HYBRID = 4
    DAMPING = 5


@dataclass(frozen=True)
class Inputs:
    """What the state machine decides by.

    Attributes:
        buttons: pressed on the remote; None: unknown, as no frame is believed, or no remote near.
        fault: what is wrong; "" for nothing.
        posed: whether the phase's slow motion has come to its end, and the joints with it.
        settled: whether the estimator knows the state.
        planner: whether the planner has been heard of.
    """

    buttons: Button | None = NOTHING
    fault: str = ""
    posed: bool = False
    settled: bool = False
    planner: bool = False


class Machine:
    """The state machine; damping is latched.

    Attributes:
        phase: where it is.
        reason: why it is damped; "" if it is not.
        asked: whether the operator has asked for the handstand.
        hint: why the last press of START did nothing; "" if it did something.
    """

    def __init__(self) -> None:
        self.phase = Phase.PASSIVE
        self.reason = ""
        self.asked = False
        self.hint = ""
        # all pressed: what is held down when the program starts is no press
        self._before = ~Button(0)

    def step(self, inputs: Inputs) -> Phase:
        """The phase after these inputs."""
        # a button that is held while frames get lost is not pressed anew after them
        buttons = self._before if inputs.buttons is None else inputs.buttons
        pressed, self._before = buttons & ~self._before, buttons
        if self.phase == Phase.DAMPING:
            return self.phase
        if inputs.buttons is not None and buttons & EMERGENCY == EMERGENCY:
            return self.damp("the operator pressed L2 and B")
        if inputs.fault and self.phase != Phase.PASSIVE:
            return self.damp(inputs.fault)
        if pressed & Button.SELECT:
            if self.phase in (Phase.STAND, Phase.READY):
                self.phase = Phase.LIE
            elif self.phase in (Phase.LIE, Phase.HYBRID):
                return self.damp("the operator pressed SELECT")
            return self.phase
        if self.phase == Phase.STAND and inputs.posed and inputs.settled:
            self.phase = Phase.READY
        elif pressed & Button.START:
            self._start(inputs)
        return self.phase

    def damp(self, reason: str) -> Phase:
        """Latch the damping."""
        if self.phase != Phase.DAMPING:
            self.phase, self.reason = Phase.DAMPING, reason
        return self.phase

    def _start(self, inputs: Inputs) -> None:
        self.hint = ""
        if self.phase == Phase.PASSIVE:
            self.hint = inputs.fault
            self.phase = self.phase if inputs.fault else Phase.LIE
        elif self.phase == Phase.LIE:
            self.hint = "" if inputs.posed else "the robot does not lie yet"
            self.phase = Phase.STAND if inputs.posed else self.phase
        elif self.phase == Phase.READY:
            if not inputs.planner:
                self.hint = "the planner has not started yet"
            elif not inputs.posed:
                self.hint = "a joint is not where it should be"
            else:
                self.phase = Phase.HYBRID
        elif self.phase == Phase.HYBRID:
            self.asked = True
        else:
            self.hint = "the robot is not ready yet"


@dataclass(frozen=True)
class Body:
    """What envelopes are about.

    Attributes:
        up: world z of each body axis, (3,).
        height: of the base [m]; NaN: unknown.
        q, dq, tau: of the joints [rad], [rad/s], [N m], (12,).
        velocity_std: of the estimated velocity in the body frame [m/s]; 0 where nothing rests on it.
        tilt_std: of the estimated attitude [rad]; likewise.
    """

    up: Array
    height: float
    q: Array
    dq: Array
    tau: Array
    velocity_std: float = 0.0
    tilt_std: float = 0.0


def violations(cfg: EnvelopeCfg, body: Body, since: float) -> list[str]:
    """Which limits the body exceeds, `since` seconds after the entry of the phase or mode.

    A number that is none exceeds its limit; an unknown height does not.
    """
    found = []

    def least(what: str, value: float, low: float, unit: str) -> None:
        if not value >= low:
            found.append(f"{what} is {value:.3g} {unit}, at least {low:g} allowed")

    def most(what: str, value: float, high: float, unit: str) -> None:
        if not value <= high:
            found.append(f"{what} is {value:.3g} {unit}, at most {high:g} allowed")

    low, high = cfg.joints
    if not (beyond := np.maximum(low - body.q, body.q - high)).max() <= 0.0:
        i = int(np.argmax(np.where(np.isnan(beyond), math.inf, beyond)))
        found.append(f"{facts.JOINTS[i]} is {body.q[i]:.3g} rad, {low[i]:g} to {high[i]:g} allowed")
    most("lean", abs(float(np.degrees(lean(body.up)))), cfg.lean, "deg")
    most("joint speed", float(np.abs(body.dq).max()), cfg.joint_speed, "rad/s")
    most("joint torque", float((np.abs(body.tau) / PEAK_TORQUE).max()), cfg.torque, "of the motor's peak")
    most("velocity uncertainty", body.velocity_std, cfg.velocity_std, "m/s")
    most("tilt uncertainty", float(np.degrees(body.tilt_std)), cfg.tilt_std, "deg")
    if since >= cfg.settle:
        angle = float(np.degrees(pitch(body.up)))
        least("pitch", angle, cfg.pitch[0], "deg")
        most("pitch", angle, cfg.pitch[1], "deg")
        if body.height == body.height:
            least("height", body.height, cfg.height[0], "m")
            most("height", body.height, cfg.height[1], "m")
    return found


class Envelope:
    """Envelopes over time: what is exceeded for longer than its patience is a fault."""

    def __init__(self) -> None:
        self._since: float | None = None

    def check(self, cfg: EnvelopeCfg, name: str, body: Body, since: float, t: float) -> str:
        """The fault, or "".

        Args:
            cfg: limits.
            name: of the phase or mode.
            body: now.
            since: time since its entry [s].
            t: time now [s].
        """
        found = violations(cfg, body, since)
        if not found:
            self._since = None
            return ""
        if self._since is None:
            self._since = t
        return f"in {name}: {found[0]}" if t - self._since >= cfg.patience else ""


def limited(target: Array, last: Array, step: float) -> Array:
    """Joint targets [rad], (12,), within the joints' limits and at most `step` from the last ones.

    Raises:
        ValueError: a target is not a number.
    """
    if not np.isfinite(target).all():
        joint = facts.JOINTS[int(np.flatnonzero(~np.isfinite(target))[0])]
        raise ValueError(f"the target of {joint} is {target[~np.isfinite(target)][0]}")
    near = np.minimum(np.maximum(target, last - step), last + step)
    return np.minimum(np.maximum(near, LOWER), UPPER)
