"""Engines run tasks in processes of this machine (`local`) or on a Ray cluster (`cluster`).

A task is a module-level function of one picklable argument; its result must not depend on where, when or beside what it
runs. A process may die during a task, which is then repeated: so a task must tolerate running twice.
"""

from simtest.runtime.engines.engine import ENGINES, Engine, OnStep, Task, make_engine

__all__ = ["ENGINES", "Engine", "OnStep", "Task", "make_engine"]
