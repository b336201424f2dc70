import inspect

from meta_envs.conformance import CHECKS, definitions, describe, episodes, run, subject
from tests.meta_envs.conformance.examples import broken


def test_every_check_is_on_the_list_and_says_what_it_is_about() -> None:
    functions = {
        function
        for module in (definitions, episodes)
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__
        and not name.startswith("_")
        and list(inspect.signature(function).parameters)[:1] == ["subject"]
    }
    assert functions == set(CHECKS)
    sentences = [describe(check) for check in CHECKS]
    assert len(set(sentences)) == len(CHECKS)
    assert all(sentence.endswith(".") for sentence in sentences)


def test_outcomes_have_a_reason_where_a_check_did_not_pass() -> None:
    with subject(broken("Sound")) as sound:
        outcomes = list(run(sound))
    assert [outcome.check for outcome in outcomes] == [describe(check) for check in CHECKS]
    assert {(outcome.status, outcome.reason) for outcome in outcomes} == {("passed", "")}
    with subject(broken("EndsAtOnce")) as short:
        statuses = {outcome.status: outcome.reason for outcome in run(short)}
    assert statuses == {"passed": "", "skipped": "episodes are too short to tell"}
    with subject(broken("TermsDoNotAddUp")) as faulty:
        failures = [outcome for outcome in run(faulty) if outcome.status == "failed"]
    assert [failure.check for failure in failures] == [describe(definitions.reward_terms_add_up)]


def test_what_cannot_be_made_is_checked_no_further() -> None:
    with subject(broken("CannotBeMade")) as absent:
        outcomes = list(run(absent))
    assert len(outcomes) == len(CHECKS)
    assert (outcomes[0].status, outcomes[0].reason) == ("failed", "RuntimeError: no licence")
    assert {outcome.status for outcome in outcomes[1:]} == {"skipped"}
