"""The linear relaxation of budgeted maximum coverage, by the primal-dual hybrid gradient method.

max_x min_u  sum_j (w_j - u_j) + u_j (A' x)_j  over 0 <= x <= 1, at most one a pole, cost' x <= budget, with a dual
0 <= u_j <= w_j for each group. Any such u gives a proven bound: with p = A u,

    covered weight <= sum_j (w_j - u_j) + max { p' x : x feasible }
                   <= sum_j (w_j - u_j) + l budget + sum_poles max(0, max_sensors p - l cost)    for any price l >= 0.

Applegate et al., "Practical large-scale linear programming using primal-dual hybrid gradient" (2021), with the step
sizes of Pock and Chambolle (2011), averages and restarts.
"""

from dataclasses import dataclass
from math import fsum

import numpy as np

from flcav.geometry.arrays import Array
from flcav.optimization.placement.instance import TIE, CoverageInstance

STEPS = 1600
RESTARTS = (200, 400, 800)  # steps after which the average is the new start
LOOK = 50  # steps between two looks at the bound
SETTLED = 2e-5  # relative gain in the bound since the last restart below which it has converged
NOTHING = 1e-12
EPS = 2.0**-52  # relative rounding of an operation with floats, rounded up


@dataclass(frozen=True)
class Relaxation:
    """A dual solution: its bound on the covered weight, and by how much the choice of a candidate lowers it."""

    bound: float  # proven: no choice within the budget covers more
    share: Array  # (N,) in [0, 1], fractional choice
    loss: Array  # (N,) by how much the bound falls if a candidate is in the choice
    spare: float  # weight that the bound holds without any sensor: sum_j (w_j - u_j) + sum_poles ...
    price: float  # bound = spare + price * budget, for any budget
    dual: Array  # (K,) of each group, in [0, weight]


def relax(instance: CoverageInstance, budget: float, enough: float = 0.0) -> Relaxation:
    """Return the best bound found; stop early when it has converged, or has reached `enough` (a covered weight)."""
    covers = instance.covers
    weight = instance.weight
    cost = instance.cost
    kinds = instance.sensors
    by_group = covers.T.tocsr()
    poles = len(cost) // kinds
    total = float(weight.sum())
    reached = np.maximum(covers @ weight, NOTHING)
    of_pole = reached.reshape(poles, kinds).mean(axis=1)
    costs = max(float(cost.sum()), NOTHING)
    budget_scale = total / max(budget, NOTHING)
    # Diagonal preconditioning (Pock and Chambolle 2011): a step is the inverse of its row's or column's absolute sum.
    step = 1.0 / (reached + budget_scale * cost + np.repeat(of_pole, kinds))
    step_u = weight / np.bincount(covers.indices, minlength=len(weight))
    step_pole = of_pole / kinds
    step_price = budget_scale / costs

    x, u, pole, price = np.zeros(len(cost)), weight.copy(), np.zeros(poles), 0.0
    sums = (np.zeros(len(cost)), np.zeros(len(weight)), np.zeros(poles), 0.0)
    counted = 0
    best = bound_by(instance, budget, np.zeros(len(weight)), x)
    before = best.bound
    for number in range(1, STEPS + 1):
        ahead = np.clip(x + step * (covers @ u - np.repeat(pole, kinds) - price * cost), 0.0, 1.0)
        middle = 2 * ahead - x
        u = np.clip(u - step_u * (by_group @ middle - 1.0), 0.0, weight)
        pole = np.maximum(pole + step_pole * (middle.reshape(poles, kinds).sum(axis=1) - 1.0), 0.0)
        price = max(price + step_price * float(cost @ middle - budget), 0.0)
        x = ahead
        sums, counted = (sums[0] + x, sums[1] + u, sums[2] + pole, sums[3] + price), counted + 1
        if number % LOOK == 0:
            for dual, primal in ((u, x), (sums[1] / counted, sums[0] / counted)):
                best = min(best, bound_by(instance, budget, dual, primal), key=lambda each: each.bound)
            if best.bound <= enough * (1 + TIE):
                break
        if number in RESTARTS:
            if number > RESTARTS[0] and before - best.bound <= SETTLED * before:
                break
            x, u, pole, price = (each / counted for each in sums)
            sums, counted = tuple(0.0 * each for each in sums), 0
            before = best.bound
    return best


def bound_by(instance: CoverageInstance, budget: float, u: Array, share: Array) -> Relaxation:
    """Return the bound that the dual values `u` (K,) in [0, weight] prove, at the price that makes it least."""
    kinds = instance.sensors
    gain = (instance.covers @ u).reshape(-1, kinds)
    cost = instance.cost.reshape(-1, kinds)
    rows = np.arange(len(gain))
    free = fsum((instance.weight - u).tolist())

    def net_of(price: float) -> Array:
        return gain - price * cost

    def spare_of(price: float) -> float:
        return free + float(np.maximum(net_of(price).max(axis=1), 0.0).sum())

    low, high = 0.0, float(np.divide(gain, cost, out=np.zeros_like(gain), where=cost > 0).max(initial=0.0))
    for _ in range(200):  # the derivative by the price is the budget less what the best choice at that price costs
        if high - low <= EPS * high or high * budget <= EPS * free:
            break
        middle = (low + high) / 2
        net = net_of(middle)
        best = net.argmax(axis=1)
        bought = float(cost[rows, best][net[rows, best] > 0].sum())
        low, high = (middle, high) if bought > budget else (low, middle)
    price = min((low, high), key=lambda each: spare_of(each) + each * budget)
    net = net_of(price)
    loss = np.maximum(net.max(axis=1, keepdims=True), 0.0) - net
    above = 1 + EPS * (np.diff(instance.covers.indptr).reshape(-1, kinds) + 4)  # sums are rounded outward from here on
    worth = (gain * above - price * cost * (1 - 2 * EPS)).max(axis=1)
    spare = fsum((free, *np.maximum(worth, 0.0).tolist())) * (1 + 4 * EPS) + 4 * EPS * float(instance.weight.sum())
    bound = (spare + price * budget * (1 + 4 * EPS)) * (1 + 2 * EPS)
    return Relaxation(bound, share, loss.ravel(), spare, price, u)
