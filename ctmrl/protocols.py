"""The names of the meta-test's protocols; imports no library, so that commands start quickly."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

Protocol = Literal["np_online", "online", "offline", "codes"]
"""How contexts come about, the first three by the names that the field's code (CSRO's) has: by
episodes of random actions and then of the policy, of the deterministic policy alone, by the task's
own data; or by the best of episodes that act on the codes and then on contexts."""

NP_ONLINE: Mapping[Protocol, None] = MappingProxyType({"np_online": None})
"""The protocol that training ends with, which needs no data."""
