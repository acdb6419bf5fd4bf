"""Attacks of a curious server: gradient inversion of an update, and membership inference on the final weights.

Inversion: the gradient of a dense layer with bias is at_hidden x^T and at_hidden, of one picture with the layer's
input x; so the quotient of both is x (Geiping et al., "Inverting Gradients", NeurIPS 2020, proposition 3.1), and their
least-squares quotient over the rows is x under noise. Of several pictures it is a mixture. Zhu et al. ("Deep Leakage
from Gradients", NeurIPS 2019) search for the same input by descent.

Membership: who was trained on has a lower loss (Yeom et al., "Privacy Risk in Machine Learning", CSF 2018).
"""

import numpy as np
from numpy.typing import NDArray

from flcav.experiments.attacks.drives import HIDDEN, Vector
from flcav.federation.trainable import Weights


def invert(start: Weights, sent: Weights) -> Vector:
    """Return the input of layer F6 (120,) that explains the change of its weights and biases best.

    x = sum_i b_i W_i / sum_i b_i^2 over rows W_i and biases b_i of the change; zeros where no bias changed.
    """
    rows = np.asarray(sent[f"{HIDDEN}.weight"], np.float64) - start[f"{HIDDEN}.weight"]
    biases = np.asarray(sent[f"{HIDDEN}.bias"], np.float64) - start[f"{HIDDEN}.bias"]
    return (biases @ rows / max(float(biases @ biases), 1e-30)).astype(np.float32)


def name_nearest(found: Vector, known: Vector) -> int:
    """Return which of the known inputs (N, 120) has the largest cosine similarity with the one that was found."""
    return int(np.argmax(known @ found / np.maximum(np.linalg.norm(known, axis=1), 1e-12)))


def membership_auc(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the chance that a member has a lower loss than another picture, ties counted half."""
    less = members[:, None] < others[None]
    same = members[:, None] == others[None]
    return float(less.mean() + same.mean() / 2)


def membership_advantage(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the shares of members and of others with a loss up to the members' mean, one less the other."""
    limit = members.mean()
    return float((members <= limit).mean() - (others <= limit).mean())
