"""Logistic regression by Newton's method: weights of columns for the probability of a label."""

import numpy as np

from evetac_cli.arrays import Floats

ROUNDS = 50  # of Newton's method, without any other stopping rule
LONGEST_STEP = 3.0  # largest change of a weight per round: far from the optimum a whole Newton step would overshoot


def fit(columns: Floats, label: Floats, penalty: Floats, importance: Floats) -> Floats:
    """Return weights (k,) from columns (n, k) and labels 0 or 1 (n,).

    They minimise the negative log likelihood plus half of penalty (k,) times the squared weights; importance (n,):
    weight of each row.
    """
    from scipy.special import expit  # here, because other users of the module do not need scipy

    weights = np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        probability = expit(columns @ weights)
        slope = columns.T @ (importance * (probability - label)) + penalty * weights
        bend = (columns * (importance * probability * (1 - probability))[:, None]).T @ columns + np.diag(penalty)
        weights = weights - np.clip(np.linalg.solve(bend, slope), -LONGEST_STEP, LONGEST_STEP)
    return weights
