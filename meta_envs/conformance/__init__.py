"""Conformance: what every environment must do, as checks that anybody's can be put to."""

from meta_envs.conformance.checklist import CHECKS, Outcome, describe, run
from meta_envs.conformance.subject import (
    NonConformityError,
    NotApplicableError,
    Subject,
    lent,
    subject,
)

__all__ = [
    "CHECKS",
    "NonConformityError",
    "NotApplicableError",
    "Outcome",
    "Subject",
    "describe",
    "lent",
    "run",
    "subject",
]
