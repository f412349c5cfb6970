"""Sentences about comparisons: which condition is better, and what limits the verdict."""

import math
from itertools import chain, combinations

from hlsim.evaluation.comparison import ConditionComparison
from hlsim.evaluation.measures import column_title
from hlsim.evaluation.result import Evaluation

_ALPHA = 0.05
"""p value below which a change is called significant."""

_LEVEL_TOLERANCE_DB = 1.0
"""Change of the level in dB that is too small to explain a change of a score."""


def verdict(c: ConditionComparison, subject: str = "", rival: str = "", noun: str = "item") -> str:
    """Return a sentence that says which condition is better, with scores and p values.

    If each test that counts has a p value below 0.05, the condition ``after`` "is better" or worse
    than ``before``; if only one of two tests has, it "may be". If none has, the conditions "cannot
    be distinguished". A test counts if it is defined and its p value can be below 0.05. If the
    output levels differ by 1 dB or more or are not known, the sentence says that the condition
    "scores higher" or lower instead, because HASPI rises with gain.

    Args:
        c: Comparison of two conditions.
        subject: Words that begin the sentence instead of the name of the condition ``after``.
        rival: Words instead of the name of the condition ``before``.
        noun: Singular noun for what is counted.

    >>> import pandas
    >>> from hlsim.evaluation import compare
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> verdict(compare(table, ["haspi"])[0])[:52]
    'b cannot be distinguished from a: HASPI 0.400 agains'
    """
    rises = c.overall.delta > 0
    significant = _significant_tests(c)
    if not any(significant):
        verb = "cannot be distinguished from"
    elif abs(c.level_change) < _LEVEL_TOLERANCE_DB:
        verb = "is" if all(significant) else "may be"
        verb += " better than" if rises else " worse than"
    else:
        verb = "scores" if all(significant) else "may score"
        verb += " higher than" if rises else " lower than"
    text = f"{subject or c.after} {verb} {rival or c.before}"
    if abs(c.level_change) >= _LEVEL_TOLERANCE_DB:
        direction = "softer" if c.level_change > 0 else "louder"
        text += f", which is {abs(c.level_change):.1f} dB {direction}"
    facts = f"{count_items(c.overall.n, noun)}, change {c.overall.delta:+.3f}"
    if c.overall.ci_low is not None:
        facts += f", 95 % interval {c.overall.ci_low:+.3f} to {c.overall.ci_high:+.3f}"
    means = f"{c.title} {c.overall.after_mean:.3f} against {c.overall.before_mean:.3f}"
    return f"{text}: {means} ({facts}; {_describe_tests(c)})."


def limits(c: ConditionComparison) -> str:
    """Return the caveats of a verdict as text.

    These are the change in level, and whether it may explain that of HASPI; items that are not
    independent; items that are left out; and that the score is a prediction.

    Args:
        c: Comparison of two conditions.

    >>> import pandas
    >>> from hlsim.evaluation import compare
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> limits(compare(table, ["haspi"])[0])[:38]
    'The tests treat items as independent. '
    """
    sentences = []
    change, delta = c.level_change, c.overall.delta
    if not math.isnan(change):
        sentences.append(f"The mean level changed by {change:+.1f} dB.")
    may_be_gain = change * delta > 0 and abs(change) >= _LEVEL_TOLERANCE_DB
    if c.measure == "haspi" and may_be_gain and any(_significant_tests(c)):
        sentences.append("HASPI rewards gain, which alone may explain the change.")
    sentences.append(_describe_units(c))
    if c.left_out:
        sentences.append(f"{count_items(c.left_out)} without both scores are left out.")
    sentences.append(
        f"{c.title} is the prediction of a model: no listener was asked, and other speech and "
        "other ears may give other results."
    )
    return " ".join(sentences)


def describe_means(evaluation: Evaluation) -> str:
    """Return a sentence with the mean score of each condition, to replace a verdict.

    Args:
        evaluation: Evaluation without comparisons.

    >>> import pandas
    >>> from hlsim.evaluation import MEASURES, Condition
    >>> table = pandas.DataFrame({"item": [0], "condition": ["a"], "haspi": [0.5], "level": [65.0]})
    >>> describe_means(Evaluation([], [Condition("a")], [MEASURES["haspi"]], table))
    'HASPI of the condition a is 0.500 on average (1 item, at 65.0 dB SPL).'
    """
    measure = evaluation.scores[0]
    means = []
    for name in evaluation.names:
        rows = evaluation.table[evaluation.table["condition"] == name].dropna(subset=[measure])
        if rows.empty:
            means.append(f"of {name} is not known")
            continue
        means.append(
            f"of the condition {name} is {rows[measure].mean():.3f} on average "
            f"({count_items(len(rows))}, at {rows['level'].mean():.1f} dB SPL)"
        )
    end = "" if len(means) == 1 else "; no item has two scores, so that nothing can be compared"
    return f"{column_title(measure)} {', '.join(means)}{end}."


def describe_missing_pairs(evaluation: Evaluation) -> list[str]:
    """Return a list with a sentence that names the pairs without a comparison, or an empty list.

    Two conditions are not compared if no item has the scores of both. If the evaluation has a
    setting ``baseline``, only pairs that begin with it count, otherwise all pairs. Without any
    comparison, the list is empty, because ``describe_means`` says so.

    Args:
        evaluation: The evaluation.

    >>> describe_missing_pairs(Evaluation([], [], [], None))
    []
    """
    if not evaluation.comparisons:
        return []
    names, baseline = evaluation.names, evaluation.settings.get("baseline")
    compared = {(c.before, c.after) for c in evaluation.comparisons}
    missing = [
        f"{first} and {second}"
        for first, second in combinations(names, 2)
        if baseline in (None, first) and (first, second) not in compared
    ]
    if not missing:
        return []
    hint = " Check the names of the conditions." if {*names} - {*chain(*compared)} else ""
    return [f"Not compared, because no item has both scores: {', '.join(missing)}.{hint}"]


def format_p(p: float) -> str:
    """Format a p value for a sentence, with five decimals or as ``p < 0.00001``.

    >>> format_p(0.0125)
    'p = 0.01250'
    """
    return "p < 0.00001" if p < 1e-5 else f"p = {p:.5f}"


def count_items(count: int, noun: str = "item") -> str:
    """Return a number with its noun, in the plural unless it is 1.

    >>> count_items(1), count_items(3, "voice")
    ('1 item', '3 voices')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _describe_tests(c: ConditionComparison) -> str:
    """Return a text with the p values of both tests, and how they are adjusted."""
    tests = {"t-test": c.p_t, "Wilcoxon": c.p_w}
    stated = [f"{name} {format_p(p)}" for name, p in tests.items() if p is not None]
    if not stated:
        return "neither test is defined"
    if c.planned:
        stated.append("planned comparison, not adjusted")
    elif c.family > 1:
        stated.append(f"adjusted by Holm for {c.family} comparisons")
    return ", ".join(stated)


def _significant_tests(c: ConditionComparison) -> list[bool]:
    """Return a list of whether the p value of the t-test and of Wilcoxon's test is below 0.05.

    A test that is not defined is left out. So is Wilcoxon's test if there are so few items that its
    p value cannot be below 0.05.
    """
    decisions = [] if c.p_t is None else [c.p_t < _ALPHA]
    lowest_p = c.family * 2.0 ** (1 - (c.overall.n - c.overall.zeros))
    if c.p_w is not None and (c.p_w < _ALPHA or lowest_p < _ALPHA):
        decisions.append(c.p_w < _ALPHA)
    return decisions


def _describe_units(c: ConditionComparison) -> str:
    means = c.unit_means
    if means is None:
        return (
            "The tests treat items as independent. If several share a talker or a listener, p is "
            "too small and the interval too narrow."
        )
    result = "is not defined" if means.p_t is None else f"gives {format_p(means.p_t)}"
    return (
        "The interval and the tests treat items as independent, although several share one "
        f"{c.unit}; the t-test over the means of the {means.n} {c.unit}s {result}."
    )
