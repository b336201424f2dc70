"""The registered environments by what moves them."""

from meta_envs import ENVIRONMENTS

POINT_ROBOTS = ("point_robot", "point_robot_wind", "sparse_point_robot")
MUJOCO_ROBOTS = tuple(name for name in ENVIRONMENTS if name not in POINT_ROBOTS)
