"""Who does the work: processes of this machine, or a Ray cluster.

A task is a function of this package with one argument that can be pickled; its result must not depend on where, when or
beside what it runs. A process may die under a task, which is then done again: so a task must bear being done twice.
"""

from simtest.runtime.engines.engine import ENGINES, Engine, Task, Tell, make_engine

__all__ = ["ENGINES", "Engine", "Task", "Tell", "make_engine"]
