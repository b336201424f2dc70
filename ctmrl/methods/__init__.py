"""The methods: one row each."""

from __future__ import annotations

from typing import NamedTuple

from ctmrl.methods.base import Method, MethodConfig
from ctmrl.methods.ctmrl import CTMRL, CTMRLConfig
from ctmrl.methods.ctmrl_released import CTMRLReleased, CTMRLReleasedConfig
from ctmrl.methods.focal import FOCAL, FOCALConfig
from ctmrl.methods.no_context import NoContext, NoContextConfig
from ctmrl.methods.oracle_task import OracleTask, OracleTaskConfig


class Row(NamedTuple):
    """A method: its class, its config's class, and what it is in a few words."""

    method: type[Method]
    config: type[MethodConfig]
    summary: str


METHODS: dict[str, Row] = {
    "ctmrl": Row(CTMRL, CTMRLConfig, "codebook of cross-task contexts (the source paper)"),
    "ctmrl_released": Row(
        CTMRLReleased, CTMRLReleasedConfig, "CTMRL as the source paper's published code has it"
    ),
    "focal": Row(FOCAL, FOCALConfig, "distance metric between contexts (Li et al. 2021)"),
    "oracle_task": Row(OracleTask, OracleTaskConfig, "reference: given the true task"),
    "no_context": Row(NoContext, NoContextConfig, "reference: contexts are 0"),
}
