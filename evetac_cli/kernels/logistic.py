"""Logistic regression: weights of columns of numbers that make one of two labels likely, by Newton's method."""

import numpy as np

from evetac_cli.arrays import Floats

ROUNDS = 50
LONGEST_STEP = 3.0  # of a weight in a round: from afar the curve is flat, and a whole step would go too far


def fit(columns: Floats, label: Floats, penalty: Floats, importance: Floats) -> Floats:
    """Weights (k,) from columns (n, k) and labels 0 or 1 (n,).

    penalty (k,): half of it times the squared weight is added to what is least, minus the log likelihood;
    importance (n,): how often a row counts.
    """
    from scipy.special import expit  # here, as modules that share this one need none of it

    weights = np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        probability = expit(columns @ weights)
        slope = columns.T @ (importance * (probability - label)) + penalty * weights
        bend = (columns * (importance * probability * (1 - probability))[:, None]).T @ columns + np.diag(penalty)
        weights = weights - np.clip(np.linalg.solve(bend, slope), -LONGEST_STEP, LONGEST_STEP)
    return weights
