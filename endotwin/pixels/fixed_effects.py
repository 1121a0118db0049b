"""Robust linear least squares with one free intercept a group: "fixed effects".

Subtracting each group's mean from target and columns takes the intercepts out exactly, so that thousands of
unknown albedos cost two histograms a column. A second kind of intercept (of frames, say) is solved for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csr_array

from endotwin.robust import robust_std

HUBER = 1.345
REWEIGHTS = 5
DENSE = 8
"""A matrix of at most so many cells a value is kept whole."""

RIDGE = 1e-9
"""Share of the trace added to the normal matrix: a column without variation gets the coefficient 0."""


@dataclass(frozen=True)
class Design:
    """What explains N values.

    Attributes:
        columns: float [N, C]. group: int [N] in 0 … count − 1, each with its own intercept.
        category: int [N], a second partition whose intercepts are wanted (the first is 0); None: there is
        none.
        weight: [N], inverse variances up to one factor; None: all alike.
        prior: precision [C, C] and pull [C] of the coefficients, beside values of variance 1 / weight; None:
        nothing is known of them.
        positive: so many of the first coefficients are not below 0.
        ridge: [C], that a coefficient is 0 is told by this share of what values tell of it alone; None: 0.
    """

    columns: np.ndarray
    group: np.ndarray
    count: int
    category: np.ndarray | None = None
    weight: np.ndarray | None = None
    prior: tuple[np.ndarray, np.ndarray] | None = None
    ridge: np.ndarray | None = None
    positive: int = 0

    def __getitem__(self, rows: np.ndarray) -> Design:
        category, weight = (None if x is None else x[rows] for x in (self.category, self.weight))
        columns, group = self.columns[rows], self.group[rows]
        return Design(columns, group, self.count, category, weight, self.prior, self.ridge, self.positive)

    @property
    def trust(self) -> np.ndarray:
        """The weights [N], 1 where all are alike."""
        return np.ones(len(self.columns)) if self.weight is None else self.weight

    def explained(self, found: FixedEffects) -> np.ndarray:
        """The values [N] without the groups' intercepts."""
        values = self.columns @ found.coefficients
        return values if self.category is None else values + found.intercepts[self.category]


@dataclass(frozen=True)
class FixedEffects:
    """Coefficients float64 [C], intercepts of the categories [K], and the robust width of what is left."""

    coefficients: np.ndarray
    intercepts: np.ndarray
    width: float


def without_means(values: np.ndarray, weight: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Values [N, K] less the weighted mean of each of ``count`` groups [N]: the variation within groups."""
    total = np.maximum(np.bincount(group, weight, count), 1e-12)
    within = np.empty(values.shape[::-1])
    for column, varying in zip(values.T, within, strict=True):
        mean = np.bincount(group, weight * column, count) / total
        np.subtract(column, mean.take(group), out=varying)
    return within.T


def regress(target: np.ndarray, design: Design, categories: int = 0, rounds: int = REWEIGHTS) -> FixedEffects:
    """Huber regression (iteratively reweighted) of ``target`` [N]; ``categories`` is their number."""
    trust = design.trust
    weight, width = trust, 1.0
    group, count, slopes = design.group, design.count, design.columns.shape[1]
    for _ in range(rounds):
        normal, right = _regularised(target[:, None], design, weight, categories, width)
        right = right[:, 0]
        if design.prior is not None:
            right[:slopes] += width**2 * design.prior[1]
        solved = _solved(normal, right, design.positive)
        found = FixedEffects(solved[:slopes], np.r_[0.0, solved[slopes:]], 0.0)
        left = (target - design.explained(found))[:, None]
        left = np.abs(without_means(left, weight, group, count)[:, 0]) * np.sqrt(trust)
        width = robust_std(left, 1e-6)
        weight = trust * _held(left, width)
    return FixedEffects(found.coefficients, found.intercepts, width)


def _regularised(
    values: np.ndarray, design: Design, weight: np.ndarray, categories: int, width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix, with what is known of the coefficients, and right-hand sides of ``values`` [N, M]."""
    within = without_means(np.c_[design.columns, values], weight, design.group, design.count)
    normal, right = _normal_equations(within, weight, design, categories)
    normal[np.diag_indices_from(normal)] += RIDGE * np.trace(normal) + 1e-12
    slopes = design.columns.shape[1]
    if design.ridge is not None:
        normal[np.diag_indices(slopes)] *= 1 + design.ridge
    if design.prior is not None:
        normal[:slopes, :slopes] += width**2 * design.prior[0]
    return normal, right


def _solved(normal: np.ndarray, right: np.ndarray, positive: int) -> np.ndarray:
    """Least squares of normal equations in which so many of the first unknowns are not below 0."""
    if not positive:
        return np.linalg.solve(normal, right)
    first, rest = slice(positive), slice(positive, None)
    others = np.linalg.solve(normal[rest, rest], np.c_[normal[rest, first], right[rest]])
    root = np.linalg.cholesky(normal[first, first] - normal[first, rest] @ others[:, :-1])
    found, _ = nnls(root.T, np.linalg.solve(root, right[first] - normal[first, rest] @ others[:, -1]))
    return np.r_[found, others[:, -1] - others[:, :-1] @ found]


def _normal_equations(
    within: np.ndarray, weight: np.ndarray, design: Design, categories: int
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and right-hand sides of ``within`` [N, C + M] (the last M are targets), and of the
    categories after the first.

    Demeaning is a projection, so products of demeaned columns with plain dummies are those with demeaned
    ones.
    """
    count = design.columns.shape[1]
    slopes, targets = within[:, :count], within[:, count:]
    weighted = (slopes * weight[:, None]).T
    normal, right = weighted @ slopes, weighted @ targets
    if design.category is None:
        return normal, right
    category = design.category
    sums = [np.bincount(category, weight * column, categories) for column in within.T]
    border, border_right = np.stack(sums[:count], axis=1), np.stack(sums[count:], axis=1)
    shared = _shared(weight, design, categories)
    dummies = np.diag(np.bincount(category, weight, categories)) - shared.T @ shared
    full = np.block([[normal, border[1:].T], [border[1:], dummies[1:, 1:]]])
    return full, np.r_[right, border_right[1:]]


def _shared(weight: np.ndarray, design: Design, categories: int) -> np.ndarray | csr_array:
    """What the groups have of each category, over the root of what they have, [count, categories]; dense
    where that is small, which takes a third of the time."""
    total = np.maximum(np.bincount(design.group, weight, design.count), 1e-12)
    weight, cells = weight / np.sqrt(total).take(design.group), design.count * categories
    if cells > DENSE * len(weight):
        return csr_array((weight, (design.group, design.category)), shape=(design.count, categories))
    cell = design.group * categories + design.category
    return np.bincount(cell, weight, cells).reshape(design.count, categories)


def robust_residuals(left: np.ndarray, design: Design, width: float) -> np.ndarray:
    """What is ``left`` [N, M] of values beside what was found of the ``design``, each group at its own mean,
    in units of ``width``, that of values of weight 1; shortened so that half the square of each is the
    pseudo-Huber loss."""
    within, root = without_means(left, design.trust, design.group, design.count), np.sqrt(design.trust)
    residual = within * root[:, None] / width
    return np.sign(residual) * np.sqrt(2 * pseudo_huber(residual))


def pseudo_huber(residual: np.ndarray) -> np.ndarray:
    """Half the square of small residuals [N], and nearly the size of large ones."""
    return np.sqrt(1 + residual**2) - 1


def robust_losses(target: np.ndarray, design: Design, found: FixedEffects, width: float) -> np.ndarray:
    """Pseudo-Huber losses [N] of what was ``found``, each group at its own mean."""
    left = (target - design.explained(found))[:, None]
    return width**2 / 2 * robust_residuals(left, design, width)[:, 0] ** 2


@dataclass(frozen=True)
class Left:
    """What a design leaves of N values.

    Attributes:
        found: of the ``categories``. width: of the loss.
    """

    target: np.ndarray
    design: Design
    found: FixedEffects
    width: float
    categories: int

    @classmethod
    def of(cls, target: np.ndarray, design: Design, width: float, categories: int) -> Left:
        return cls(target, design, regress(target, design, categories, rounds=2), width, categories)

    @cached_property
    def residuals(self) -> np.ndarray:
        """Robust ones, [N]."""
        left = (self.target - self.design.explained(self.found))[:, None]
        return robust_residuals(left, self.design, self.width)[:, 0]

    def beside(self, columns: np.ndarray) -> np.ndarray:
        """``residuals`` [N, M] with other columns, M times [N, C]: coefficients and intercepts follow as if
        these had stayed (Kaufman 1975), and no value pulls them harder than a robust fit lets it."""
        design, found = self.design, self.found
        changed = ((columns - design.columns) @ found.coefficients).T
        here = (self.target - design.explained(found))[:, None]
        here = without_means(here, design.trust, design.group, design.count)
        there, width = here - changed, found.width / np.sqrt(design.trust)[:, None]
        held = _held(here, width)
        pulled = here - there * _held(there, width) / held
        weight = design.trust * held[:, 0]
        solved = np.linalg.solve(*_regularised(pulled, design, weight, self.categories, found.width))
        slopes = len(found.coefficients)
        followed = design.columns @ solved[:slopes]
        if design.category is not None:
            followed += np.pad(solved[slopes:], ((1, 0), (0, 0))).take(design.category, axis=0)
        return robust_residuals(there + followed, design, self.width)


def _held(left: np.ndarray, width: float | np.ndarray) -> np.ndarray:
    """Share of what is ``left`` of values that a robust fit heeds."""
    return np.minimum(1, HUBER * width / np.maximum(np.abs(left), 1e-12))
