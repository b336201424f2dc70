import pytest

from meta_envs.conformance import NonConformityError, NotApplicableError, definitions, subject
from meta_envs.conformance.checklist import Check
from meta_envs.tasks import TaskSet
from tests.meta_envs.conformance.examples import broken

COMPLETE = definitions.definition_is_complete
BATCHED = definitions.functions_are_batched
TERMS = definitions.reward_terms_add_up
FIXED = definitions.tasks_are_fixed
SPLITS = definitions.splits_are_sound
SAMPLER = definitions.sampler_gives_tasks
HIDDEN = definitions.task_is_hidden


@pytest.mark.parametrize(
    ("check", "name", "reason"),
    [
        (COMPLETE, "ShortName", "it calls itself 'short'"),
        (COMPLETE, "WideActions", "its actions are not from -1 to 1"),
        (COMPLETE, "NoSpace", "its observation_space is None, not a Box"),
        (COMPLETE, "DoubleSpace", "its observation_space is not a float32 Box"),
        (BATCHED, "SingleReward", r"reward gives float32 \[3\] instead of float64 \[3\]"),
        (BATCHED, "WritesIntoStates", "it writes into the states it is given"),
        (BATCHED, "SharesMemory", "reward and cost share memory"),
        (TERMS, "TermsDoNotAddUp", "its terms reward_... add up to"),
        (TERMS, "RewardOfNan", "a reward is not finite"),
        (TERMS, "ReservedTerm", "no term may be called 'task'"),
        (TERMS, "SparseAlone", "it is sparse, but has no term 'dense_reward'"),
        (FIXED, "OtherTasksEachTime", "another instance has other tasks"),
        (FIXED, "TwinTasks", "of its 6 tasks only 3 differ"),
        (FIXED, "ForeignTasks", "its tasks say they are of 'other'"),
        (SPLITS, "OverlappingSplit", r"tasks \[3\] of split 'far' are for training and for the"),
        (SPLITS, "EmptySplit", "split 'interpolate' has no train_tasks"),
        (SPLITS, "NothingOutside", r"test tasks \[1\] of 'extrapolate' are within the training"),
        (SAMPLER, "SamplerWithoutSeed", "two seeds give the same sample"),
        (SAMPLER, "SamplerOfChance", "one seed gives two samples"),
        (HIDDEN, "ShowsTheTask", r"components \[2, 3\] of the observation stay as they are"),
        (HIDDEN, "ShowsTheRow", r"components \[0, 1\] of the first observation differ"),
        (
            definitions.shared_generators_are_left_alone,
            "SharedGenerator",
            "it draws from, or seeds, a generator everyone shares",
        ),
    ],
)
def test_a_check_sees_the_fault(check: Check, name: str, reason: str) -> None:
    with subject(broken("Sound")) as sound:
        check(sound)
    with subject(broken(name)) as faulty, pytest.raises(NonConformityError, match=reason):
        check(faulty)


def test_parameters_that_are_not_the_tasks_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    with subject(broken("Sound")) as sound:
        definitions.own_params_make_the_task(sound)
        exact = TaskSet._row
        monkeypatch.setattr(TaskSet, "_row", lambda *given: [x + 1e-9 for x in exact(*given)])
        with pytest.raises(NonConformityError, match="the reward differs"):
            definitions.own_params_make_the_task(sound)


def test_short_episodes_do_not_tell_whether_the_task_is_hidden() -> None:
    with subject(broken("EndsAtOnce")) as short, pytest.raises(NotApplicableError):
        HIDDEN(short)
