"""What differs between the models of a simulator's worlds, as numbers a world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

# Values that worlds of engine warp may have of their own: what friction, masses and motors come to.
OWN = (
    *("geom_friction", "body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_invweight0"),
    *("dof_invweight0", "actuator_gainprm", "actuator_forcerange", "actuator_acc0"),
)
# Values that follow from those and that no step looks at: for pictures, sleeping, making other values.
UNSEEN = ("bvh_aabb", "dof_M0", "dof_length", "light_poscom0")


def own_values(model: mujoco.MjModel, models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
    """Values of each world's model where any differs from `model`: name -> (W, ...) float32.

    Args:
        model: what they are compared with.
        models: one a world; the same one may come many times.

    Raises:
        ValueError: the models differ in something that cannot differ between worlds.
    """
    distinct = {id(each): each for each in models}
    place = {key: i for i, key in enumerate(distinct)}
    kind = [place[id(each)] for each in models]
    found = {}
    for name, value in _values(model):
        values = [_value(each, name) for each in distinct.values()]
        if name in UNSEEN or all(np.array_equal(value, other) for other in values):
            continue
        if name not in OWN:
            raise ValueError(
                f"the models of the worlds differ in {name}, on engine warp they may in {', '.join(OWN)}: "
                "take engine mujoco"
            )
        found[name] = np.stack(values).astype(np.float32)[kind]
    return found


def _value(model: mujoco.MjModel, name: str) -> Any:
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def _values(model: mujoco.MjModel) -> Iterator[tuple[str, Any]]:
    """All arrays of a model and all of its options."""
    for prefix, part, kinds in (("", model, np.ndarray), ("opt.", model.opt, (np.ndarray, int, float))):
        for name in dir(part):
            if not name.startswith("_") and isinstance(value := getattr(part, name), kinds):
                yield prefix + name, value
