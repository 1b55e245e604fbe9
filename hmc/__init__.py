"""Hybrid mode control: plan which controller a robot runs, when, and for how long."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hmc.budget import Budget as Budget
    from hmc.cost import Cost as Cost
    from hmc.ensemble import Ensemble as Ensemble
    from hmc.evaluate import Evaluator as Evaluator
    from hmc.modes import ConstantInput as ConstantInput
    from hmc.modes import Mode as Mode
    from hmc.modes import ModeSet as ModeSet
    from hmc.modes import Motion as Motion
    from hmc.planner import Plan as Plan
    from hmc.planner import PlanInterrupted as PlanInterrupted
    from hmc.planner import plan as plan
    from hmc.receding import Receding as Receding
    from hmc.receding import Tick as Tick
    from hmc.rules import Rules as Rules
    from hmc.schedule import Schedule as Schedule
    from hmc.schedule import Switch as Switch
    from hmc.schedule import SwitchSpace as SwitchSpace
    from hmc.sim.base import Sim as Sim
    from hmc.start import Start as Start
    from hmc.start import make_start as make_start
    from hmc.task import Task as Task
    from hmc.trace import Trace as Trace

# Loaded on first use: a process that needs one constant of a robot does not pay for torch.
_HOME = {
    "Budget": "hmc.budget",
    "Cost": "hmc.cost",
    "Ensemble": "hmc.ensemble",
    "Evaluator": "hmc.evaluate",
    "Mode": "hmc.modes",
    "ModeSet": "hmc.modes",
    "ConstantInput": "hmc.modes",
    "Motion": "hmc.modes",
    "Plan": "hmc.planner",
    "PlanInterrupted": "hmc.planner",
    "plan": "hmc.planner",
    "Receding": "hmc.receding",
    "Tick": "hmc.receding",
    "Rules": "hmc.rules",
    "Schedule": "hmc.schedule",
    "Switch": "hmc.schedule",
    "SwitchSpace": "hmc.schedule",
    "Sim": "hmc.sim.base",
    "Start": "hmc.start",
    "make_start": "hmc.start",
    "Task": "hmc.task",
    "Trace": "hmc.trace",
}
__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hmc' has no attribute {name!r}: it has {', '.join(_HOME)}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
