"""Automatic classification: clusters of features, by four methods of well-kept libraries and one of our own.

Each method is a function from samples to a `Predict`, which gives the class of any features.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context

Floats = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.int32]
Predict = Callable[[Floats], Numbers]
"""From (n, features) to the (n,) number of the class of each."""

Method = Literal["k_means", "gaussian_mixture", "som", "lvq"]

SOM_SIDE = 8
"""Neurons along a side of the map."""

SOM_STEPS = 10_000
LVQ_STEPS = 20_000
LVQ_PROTOTYPES = 5
"""Of each class."""

_BLOCK = 1 << 16


def k_means(samples: Floats, classes: int, seed: int) -> Predict:
    """Cluster by k-means: the centres that leave the least squared distance.

    Lloyd's iteration from the best of eight k-means++ starts (scikit-learn).  Arthur and Vassilvitskii 2007,
    k-means++: the advantages of careful seeding, SODA '07, pp. 1027-1035.
    """
    return nearest_to(_centres(samples, classes, seed), np.arange(classes))


def gaussian_mixture(samples: Floats, classes: int, seed: int) -> Predict:
    """Cluster by a mixture of normal distributions with covariances of their own (scikit-learn).

    Expectation maximisation from k-means; a cell belongs to the class of the highest posterior.  Dempster, Laird and
    Rubin 1977, doi:10.1111/j.2517-6161.1977.tb01600.x.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    model = GaussianMixture(classes, reg_covar=1e-4, max_iter=200, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # 200 steps do for a texture
        model.fit(samples)
    return lambda features: np.asarray(model.predict(features), np.int32)


def som(samples: Floats, classes: int, seed: int) -> Predict:
    """Cluster by a self-organising map (MiniSom), whose neurons k-means gathers into classes.

    Two levels, as of Vesanto and Alhoniemi 2000, Clustering of the self-organizing map, doi:10.1109/72.846731: a map of
    8 x 8 neurons unfolds over the samples, then neurons join by distance, each counting as the samples nearest to it.
    """
    from minisom import MiniSom

    net = MiniSom(SOM_SIDE, SOM_SIDE, samples.shape[1], sigma=SOM_SIDE / 4, learning_rate=0.5, random_seed=seed)
    net.random_weights_init(samples)
    net.train(samples, SOM_STEPS, random_order=True)
    neurons = net.get_weights().reshape(-1, samples.shape[1]).astype(np.float32)
    nearest = nearest_to(neurons, np.arange(len(neurons)))(samples)
    hits = np.bincount(nearest, minlength=len(neurons))
    centres = _centres(neurons, classes, seed, hits + 1e-3)
    return nearest_to(neurons, nearest_to(centres, np.arange(classes))(neurons))


def lvq(samples: Floats, labels: Numbers, classes: int, seed: int, context: Context) -> Predict:
    """Learn from samples whose class is known, by learning vector quantisation (LVQ1).

    Each class starts with up to five prototypes, by k-means over its samples.  Then samples, drawn so that all classes
    come equally often, pull the nearest prototype where it is of their class and push it away where it is not:
    w += +-a (x - w), a falling from 0.1 to 0.  Kohonen 2001, Self-organizing maps, 3rd edition, section 6.2,
    doi:10.1007/978-3-642-56927-2.
    """
    prototypes, owner = [], []
    members = [np.flatnonzero(labels == number) for number in range(classes)]
    for number, own in enumerate(members):
        count = min(LVQ_PROTOTYPES, len(np.unique(samples[own], axis=0)))
        prototypes.append(_centres(samples[own], count, seed) if count else np.zeros((0, samples.shape[1]), np.float32))
        owner += [number] * count
    places, owners = np.concatenate(prototypes), np.array(owner, np.int32)
    dice = np.random.default_rng(seed)
    present = [own for own in members if len(own)]
    turns = dice.integers(len(present), size=LVQ_STEPS)
    picks = dice.random(LVQ_STEPS)
    for step, (turn, pick) in enumerate(zip(turns, picks, strict=True)):
        if step % 1024 == 0:
            context.progress(None)
        own = present[turn]
        index = own[int(pick * len(own))]
        offset = samples[index] - places
        nearest = int(np.argmin((offset * offset).sum(axis=1)))
        rate = 0.1 * (1 - step / LVQ_STEPS)
        places[nearest] += (rate if owners[nearest] == labels[index] else -rate) * offset[nearest]
    return nearest_to(places, owners)


def nearest_to(centres: Floats, classes: npt.NDArray[Any]) -> Predict:
    """Return what gives the class of the nearest centre."""
    centres = np.asarray(centres, np.float32)
    square = (centres * centres).sum(axis=1)
    numbers = np.asarray(classes, np.int32)

    def predict(features: Floats) -> Numbers:
        found = np.empty(len(features), np.int32)
        for start in range(0, len(features), _BLOCK):
            part = slice(start, start + _BLOCK)
            found[part] = numbers[np.argmin(square - 2 * (features[part] @ centres.T), axis=1)]
        return found

    return predict


def _centres(samples: Floats, count: int, seed: int, weight: npt.NDArray[Any] | None = None) -> Floats:
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    # Threads wait for each other longer than they work, and would add in an order that varies.
    with threadpool_limits(1, "openmp"):
        model = KMeans(count, n_init=8, random_state=seed).fit(samples, sample_weight=weight)
    return np.asarray(model.cluster_centers_, np.float32)
