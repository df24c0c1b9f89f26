"""How much of its plan a run holds."""

from eval.plans.coverage import explain_unreadable_plan, measure_coverage
from eval.plans.plan import load_plan


def test_pairs_with_all_of_their_cells_count() -> None:
    plan = load_plan("smoke")
    told = {"plan": plan.model_dump(mode="json")}
    case = (plan.worlds[0].label, plan.seeds[0], "paper")
    covered = measure_coverage(told, [case])
    assert (covered.n_done, covered.n_planned, covered.is_whole) == (0, 2, False)
    assert covered.sentence == "0 of 2 planned pairs so far: no verdict before all are there."
    assert measure_coverage({}, [case]).is_whole and explain_unreadable_plan({}) == ""


def test_a_folder_of_others_methods_alone_has_no_methods_of_a_plan_to_wait_for() -> None:
    told = {"plan": {**load_plan("smoke").model_dump(mode="json"), "variants": [], "grid": []}}
    assert measure_coverage(told, []).is_whole and explain_unreadable_plan(told) == ""


def test_a_plan_that_cannot_be_read_here_gives_no_verdict() -> None:
    told = {"plan": {**load_plan("smoke").model_dump(mode="json"), "variants": [{"preset": "elsewhere.yaml"}]}}
    covered = measure_coverage(told, [])
    assert not covered.is_whole and "elsewhere.yaml" in explain_unreadable_plan(told)
    assert covered.sentence.startswith("no verdict, as the plan of the run cannot be read here: ")
