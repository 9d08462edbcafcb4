"""Which mode each step is in, and which way it moved, decided over the run so that neither flickers."""

import numpy as np

MODES = ("still", "turning", "moving")
STILL, TURNING, MOVING = range(3)


def cheapest_path(costs: np.ndarray, *, switch_cost: float) -> np.ndarray:
    """(T,) int: the state of each step that makes costs and switches together least (Viterbi).

    Args:
        costs: (T, S) negative log likelihoods; a row of zeros says nothing.
        switch_cost: of a change between consecutive steps.
    """
    count, states = costs.shape
    total = np.zeros(states)
    came_from = np.zeros((count, states), int)
    for index in range(count):
        stay = total
        best = int(total.argmin())
        switch = total[best] + switch_cost
        came_from[index] = np.where(stay <= switch, np.arange(states), best)
        total = np.minimum(stay, switch) + costs[index]
    path = np.zeros(count, int)
    state = int(total.argmin())
    for index in range(count - 1, -1, -1):
        path[index] = state
        state = came_from[index, state]
    return path


def travel_signs(axes: np.ndarray, evidence: np.ndarray, *, turn_back_cost: float) -> np.ndarray:
    """(T,) -1 or 1: which way along its axis each step went.

    Args:
        axes: (T, 3) unit translations of ``x2 = R x1 + t``, of open sign; zero rows say nothing.
        evidence: (T,) log likelihood ratio of the axis as given.
        turn_back_cost: log likelihood that a change between forward and backward costs. The prior that cars drive
        forward
            is a fraction of it, so that evidence overrules it within a few steps.
    """
    forward = np.where(axes[:, 2] <= 0, 1.0, -1.0)
    bounded = np.clip(evidence * forward, -20.0, 20.0)
    costs = np.stack([-bounded / 2, bounded / 2], axis=1)
    costs[0, 1] += 3.0
    return np.where(cheapest_path(costs, switch_cost=turn_back_cost) == 0, forward, -forward)
