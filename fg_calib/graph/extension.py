"""The graph is the user's too: what somebody adds to a problem's graph is solved and assessed like our own.

A factor is added with `problem.graph.add(factor)`; a variable that it brings with it gets its start with
`problem.initial.insert(key, value)`. Such a variable is a *nuisance* variable (see `factors`), of any of GTSAM's types.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import gtsam

from fg_calib.errors import ProblemError
from fg_calib.graph.problem import Problem, judged_at


def with_added(problem: Problem) -> Problem:
    """The problem with what somebody added to its graph, and changed in its initial values, as a part of it.

    Raises:
        ProblemError: Factors were removed or replaced, an added variable has no start, or there is no factor of it.
    """
    more = _added_factors(problem)
    if not more and problem.initial.equals(problem.variables.values(problem.start), 0.0):
        return problem
    if more and problem.whole is not None:
        raise ProblemError("problem.graph", "added factors with gauge keep", "gauge prior or none")
    added = problem.added + more
    variables = problem.variables.without_own()
    own = gtsam.Values(problem.initial)
    for key in variables.keys:
        own.erase(key)
    theirs = set(chain.from_iterable(factor.keys() for factor in added)).difference(variables.keys)
    for key in sorted(theirs.symmetric_difference(own.keys())):
        symbol = str(gtsam.Symbol(key)).strip()
        if key in theirs:
            raise ProblemError("problem.initial", f"no value of {symbol}", "one for every variable of an added factor")
        raise ProblemError("problem.initial", f"a value of {symbol}", "none without a factor on it in problem.graph")
    variables = variables.with_own(own)
    start = variables.parameters(problem.initial)
    return judged_at(replace(problem, variables=variables, added=added), start)


def _added_factors(problem: Problem) -> tuple[gtsam.NonlinearFactor, ...]:
    """The factors in a problem's graph that it was not made of."""
    graph, own = problem.graph, problem.factors
    n, n_own = graph.size(), own.size()
    kept = sum(graph.at(i) is own.at(i) for i in range(min(n, n_own)))
    if kept < n_own:
        raise ProblemError("problem.graph", f"{kept} of the problem's {n_own} factors", "all of them, in their places")
    return tuple(graph.at(i) for i in range(n_own, n))


def check_graph(problem: Problem) -> None:
    """Check that nothing was added to the graph of a problem that has been solved.

    Raises:
        ProblemError: Its graph has other factors than it was solved with.
    """
    n = len(_added_factors(problem))
    if n:
        raise ProblemError("solution.problem.graph", f"{n} factors added since it was solved", "to be solved again")
