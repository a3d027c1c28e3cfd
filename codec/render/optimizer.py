"""Adam (Kingma and Ba 2015) on named arrays: of Gaussians, nodes, coefficients and cameras. Needs no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .backend import Backend
from .workspace import host_array


@dataclass(frozen=True)
class AdamSettings:
    """Constants of the optimiser."""

    beta1: float = 0.9
    beta2: float = 0.99  # schedules are short: the second moment averages over 100 steps
    eps: float = 1e-15


@dataclass
class _State:
    """Moments of one array, in its shape, and how many steps it has taken."""

    first: np.ndarray
    second: np.ndarray
    steps: int = 0


class Adam:
    """The optimiser of the arrays of one stage. Each name has its own moments and its own count of steps, from its
    first step on. The arrays belong to the caller, who adds and removes the same rows in the arrays and here."""

    def __init__(self, backend: Backend, settings: AdamSettings):
        self._backend, self._settings = backend, settings
        self._states: dict[str, _State] = {}

    def step(self, params: Mapping, grads: Mapping, rates: Mapping[str, float]) -> None:
        """One step, in place, of the arrays that `rates` names.

        Args:
            params: name -> f32 array or torch CPU tensor, contiguous.
            grads: name -> gradient of the same shape.
            rates: name -> learning rate, in units of the array.
        """
        s = self._settings
        for name, rate in rates.items():
            param = host_array(params[name])
            grad = np.ascontiguousarray(host_array(grads[name]), np.float32)
            if name not in self._states:
                self._states[name] = _State(np.zeros_like(param), np.zeros_like(param))
            state = self._states[name]
            state.steps += 1
            arrays = (param, grad, state.first, state.second)
            self._backend.adam(arrays, rate=rate, betas=(s.beta1, s.beta2), eps=s.eps, step=state.steps)

    def restart(self) -> None:
        """Forgets all moments and step counts."""
        self._states.clear()

    def select(self, index: np.ndarray) -> None:
        """Keeps the rows at `index` ([M] int or [N] bool) of every array."""
        for state in self._states.values():
            state.first, state.second = state.first[index], state.second[index]

    def append(self, count: int) -> None:
        """Adds `count` rows with zero moments to every array."""
        for state in self._states.values():
            more = np.zeros((count, *state.first.shape[1:]), np.float32)
            state.first, state.second = np.concatenate([state.first, more]), np.concatenate([state.second, more])

    def resize(self, name: str, columns: int) -> None:
        """Sets the number of columns (axis 1) of array `name`; new columns have zero moments."""
        if name not in self._states:
            return
        state = self._states[name]
        state.first, state.second = _resized(state.first, columns), _resized(state.second, columns)


class TrajectoryAdam:
    """The optimiser of trajectory coefficients, [K, N, C] of each attribute; a frame shows their weighted sum."""

    def __init__(self, backend: Backend, settings: AdamSettings):
        self._backend, self._settings = backend, settings
        self._states: dict[str, _State] = {}

    def step(
        self,
        name: str,
        coefficients: np.ndarray,
        grad: np.ndarray,
        at: np.ndarray,
        price: tuple[float, np.ndarray, np.ndarray] | None,
        rate: float,
    ) -> np.ndarray:
        """One step of the coefficients of attribute `name`, in place; arguments and result as in
        `Backend.trajectory_step`."""
        s, state = self._settings, self._states.get(name)
        if state is None:
            state = self._states[name] = _State(np.zeros_like(coefficients), np.zeros_like(grad))
        state.steps += 1
        arrays, betas = (coefficients, grad, state.first, state.second), (s.beta1, s.beta2)
        step = self._backend.trajectory_step
        return step(arrays, at, price, rate=rate, betas=betas, eps=s.eps, step=state.steps)

    def select(self, index: np.ndarray) -> None:
        """Keeps the Gaussians at `index` ([M] int or [N] bool)."""
        for state in self._states.values():
            state.first, state.second = np.ascontiguousarray(state.first[:, index]), state.second[index]

    def append(self, count: int) -> None:
        """Adds `count` Gaussians with zero moments."""
        for state in self._states.values():
            more = np.zeros((len(state.first), count, *state.first.shape[2:]), np.float32)
            state.first = np.concatenate([state.first, more], 1)
            state.second = np.concatenate([state.second, more[0]])


def _resized(a: np.ndarray, columns: int) -> np.ndarray:
    """[N, C, ...] -> [N, columns, ...]; new columns are 0."""
    out = np.zeros((len(a), columns, *a.shape[2:]), np.float32)
    kept = min(columns, a.shape[1])
    out[:, :kept] = a[:, :kept]
    return out
