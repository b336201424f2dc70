"""Meta-environments: families of tasks with fixed train/test splits, on Gymnasium's interface.

After `import meta_envs`, `gymnasium.make("PointRobotWind-v0", task=3)` makes task 3, and
`gymnasium.make_vec("PointRobotWind-v0", vectorization_mode="vector_entry_point", tasks=[3, 5])`
makes one sub-environment a task.
"""

from meta_envs.definition import Definition
from meta_envs.env import MetaEnv, MetaVectorEnv
from meta_envs.registry import ENVIRONMENTS, Row, register, resolve, task_set
from meta_envs.scores import normalized_score, reference_returns
from meta_envs.tasks import Split, TaskSet

__all__ = [
    "ENVIRONMENTS",
    "Definition",
    "MetaEnv",
    "MetaVectorEnv",
    "Row",
    "Split",
    "TaskSet",
    "normalized_score",
    "reference_returns",
    "register",
    "resolve",
    "task_set",
]

for _row in ENVIRONMENTS.values():
    register(_row)
