"""Whether two sets of windows can be told apart: a logistic regression, judged on windows that it was not fitted on.

All is fixed: features are standardised, weights have a penalty, windows are left out in blocks of time, the same times
in both sets. What counts is the area under the ROC curve (AUC): how often a window of the second set has a higher score
than one of the first; 0.5 where they cannot be told apart, 1 where always.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from evetac_cli.kernels import logistic

Floats = NDArray[np.float64]

FOLDS = 4
BLOCK = 2  # windows next to each other that are left out together
FEWEST = 8  # windows of a set
PENALTY, PENALTY_OF_OFFSET = 1.0, 1e-6
LARGEST_VALUE = 1e12  # of a feature: squares must stay finite
LARGEST = 6.0  # standard deviations: a window that is farther off counts as being so far


def area(first: Floats, second: Floats) -> float:
    """Share of pairs in which the second score is higher, ties half; ValueError if either has none."""
    if not len(first) or not len(second):
        raise ValueError("expected scores of both sets")
    ranks = rankdata(np.concatenate([first, second]))[len(first) :]
    return float((ranks.sum() - len(second) * (len(second) + 1) / 2) / (len(first) * len(second)))


def told_apart(first: Floats, second: Floats) -> float:
    """AUC of held-out windows (windows, features) in order of time; NaN in a feature is its mean.

    Sets are cut to one length, window by window at the same times. ValueError with fewer than FEWEST windows, or where
    features differ in number.
    """
    windows = min(len(first), len(second))
    if windows < FEWEST or first.shape[1:] != second.shape[1:]:
        raise ValueError(f"expected {FEWEST} windows or more of both, with the same features, found {windows}")
    first, second = (np.clip(part, -LARGEST_VALUE, LARGEST_VALUE) for part in (first, second))
    fold = np.arange(windows) // BLOCK % FOLDS
    penalty = np.concatenate([[PENALTY_OF_OFFSET], np.full(first.shape[1], PENALTY)])
    scores: list[Floats] = [np.empty(windows), np.empty(windows)]
    for left_out in range(FOLDS):
        held = fold == left_out
        train = np.concatenate([first[:windows][~held], second[:windows][~held]])
        known = np.isfinite(train)
        count = np.maximum(known.sum(axis=0), 1)
        mean = np.where(known, train, 0.0).sum(axis=0) / count
        sd = np.sqrt(np.where(known, (train - mean) ** 2, 0.0).sum(axis=0) / count)
        sd[sd <= 1e-9 * (1.0 + np.abs(mean))] = np.inf

        def standardised(windows_of: Floats, mean: Floats = mean, sd: Floats = sd) -> Floats:
            values: Floats = np.clip((windows_of - mean) / sd, -LARGEST, LARGEST)
            return np.where(np.isfinite(values), values, 0.0)

        label = np.repeat([0.0, 1.0], (~held).sum())
        columns = np.column_stack([np.ones(len(train)), standardised(train)])
        weights = logistic.fit(columns, label, penalty, np.ones(len(train)))
        for score, of in zip(scores, (first, second), strict=True):
            score[held] = standardised(of[:windows][held]) @ weights[1:] + weights[0]
    # Each fold has a regression of its own, whose scores are compared among themselves only.
    return float(np.mean([area(scores[0][fold == one], scores[1][fold == one]) for one in range(FOLDS)]))
