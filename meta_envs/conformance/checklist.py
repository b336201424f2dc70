"""All conformance checks in order, and how they are run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from meta_envs.conformance import definitions, episodes
from meta_envs.conformance.subject import NonConformityError, NotApplicableError, Subject

Check = Callable[[Subject], None]

CHECKS: tuple[Check, ...] = (
    definitions.definition_is_complete,
    definitions.functions_are_batched,
    definitions.reward_terms_add_up,
    definitions.tasks_are_fixed,
    definitions.splits_are_sound,
    definitions.sampler_gives_tasks,
    definitions.own_params_make_the_task,
    definitions.task_is_hidden,
    definitions.shared_generators_are_left_alone,
    episodes.passes_gymnasiums_checker,
    episodes.passes_stable_baselines3s_checker,
    episodes.vector_equals_single,
    episodes.seed_decides_everything,
    episodes.info_is_constant,
    episodes.only_the_horizon_truncates,
    episodes.spaces_hold,
    episodes.nonsense_is_refused,
    episodes.arrays_are_fresh,
    episodes.specs_rebuild_it,
    episodes.copies_go_their_own_way,
    episodes.pictures_are_arrays,
)
"""Each raises if the environment fails it; the first line of its docstring says what it checks."""


@dataclass(frozen=True)
class Outcome:
    """What came of one check.

    Attributes:
        check: what was checked, one sentence.
        status: "passed", "failed", or "skipped" where it cannot be made here.
        reason: why it failed or was skipped, one sentence; empty where it passed.
    """

    check: str
    status: Literal["passed", "failed", "skipped"]
    reason: str = ""


def describe(check: Check) -> str:
    """What a check is about, one sentence."""
    return (check.__doc__ or "").partition("\n")[0]


def run(subject: Subject) -> Iterator[Outcome]:
    """Make every check; where the Definition itself cannot be made, the others are skipped."""
    for number, check in enumerate(CHECKS):
        outcome = _outcome(check, subject)
        yield outcome
        if number == 0 and outcome.status == "failed":
            for rest in CHECKS[1:]:
                yield Outcome(describe(rest), "skipped", "the Definition cannot be made")
            return


def _outcome(check: Check, subject: Subject) -> Outcome:
    try:
        check(subject)
    except NotApplicableError as error:
        return Outcome(describe(check), "skipped", str(error))
    except NonConformityError as error:
        return Outcome(describe(check), "failed", str(error))
    # Whatever else the environment raises is its failure, not the checker's.
    except Exception as error:
        return Outcome(describe(check), "failed", f"{type(error).__name__}: {error}")
    return Outcome(describe(check), "passed")
