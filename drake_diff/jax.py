"""Steps, rollouts and plans as functions of JAX arrays in double precision, for `jit`, `grad` and `vmap`.

`step`, `rollout` and `solve` are documented at `drake_diff.bridges.functions.Functions`. They call Drake through
`jax.pure_callback`, so that errors and warnings of a call appear when JAX runs it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any
from weakref import WeakValueDictionary

from drake_diff.bridges.functions import Functions
from drake_diff.bridges.plans import PlanFunction
from drake_diff.bridges.rollouts import RolloutFunction
from drake_diff.exceptions import InputError, MissingDependencyError

try:
    import jax
    import jax.numpy as jnp
except ImportError as error:
    raise MissingDependencyError(f"it needs JAX ({error}): pip install 'drake-diff[jax]'") from error


def _call(function: Callable[..., Any], shapes: Any, *arguments: Any) -> Any:
    """Call a function of NumPy arrays, whose results have the `shapes`, for all entries of a batch at once."""
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments)):
        return jax.tree.map(jnp.asarray, function(*arguments))
    return jax.pure_callback(function, shapes, *arguments, vmap_method="broadcast_all")


def _like(shape: tuple[int, ...], kind: type = float) -> Any:
    return jax.ShapeDtypeStruct(shape, kind)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _pure_states(function: RolloutFunction, x0: Any, us: Any, *values: Any) -> Any:
    """Return the states (..., N+1, nx) of rollouts with equal leading dimensions."""
    return _states_and_saved(function, x0, us, *values)[0]


def _states_and_saved(function: RolloutFunction, x0: Any, us: Any, *values: Any) -> tuple[Any, Any]:
    (*batch, nx), count = x0.shape, us.shape[-2]
    xs, touching = _call(
        function.states, (_like((*batch, count + 1, nx)), _like((*batch, count), bool)), x0, us, values
    )
    return xs, (xs, us, touching, values)


def _pull_back_states(function: RolloutFunction, saved: tuple[Any, ...], by_xs: Any) -> tuple[Any, ...]:
    xs, us, _, values = saved
    shapes = (*xs.shape[:-2], xs.shape[-1]), us.shape, *(value.shape for value in values)
    return tuple(_call(function.pull_back, tuple(map(_like, shapes)), *saved, by_xs))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _plans(function: PlanFunction, *values: Any) -> Any:
    """Return the arrays of a plan for values with equal leading dimensions."""
    return _plans_and_saved(function, *values)[0]


def _plans_and_saved(function: PlanFunction, *values: Any) -> tuple[Any, Any]:
    batch = values[0].shape[: values[0].ndim - len(next(iter(function.shapes.values())))]
    return _call(function.plans, tuple(map(_like, function.sizes(batch))), values), values


def _pull_back_plans(function: PlanFunction, values: Any, by_plan: Any) -> tuple[Any, ...]:
    return tuple(_call(function.pull_back, tuple(_like(value.shape) for value in values), values, by_plan))


_pure_states.defvjp(_states_and_saved, _pull_back_states)
_plans.defvjp(_plans_and_saved, _pull_back_plans)


@partial(jax.jit, static_argnums=(0, 1))
def _states(function: RolloutFunction, single: bool, x0: Any, us: Any, *values: Any) -> Any:
    if single:
        return _pure_states(function, x0, us[..., None, :], *values)[..., 1, :]
    return _pure_states(function, x0, us, *values)


def _array(value: Any) -> Any:
    if jax.dtypes.canonicalize_dtype(float) != jnp.float64:
        expected = 'double precision: jax.config.update("jax_enable_x64", True)'
        raise InputError("jax_enable_x64", got="False, single precision", expected=expected)
    return jnp.asarray(value, dtype=float)


def _loop(advance: Callable[[Any, Any], Any], x0: Any, count: int) -> tuple[Any, Any]:
    def body(x: Any, k: Any) -> tuple[Any, tuple[Any, Any]]:
        x_next, u = advance(x, k)
        return x_next, (x_next, u)

    _, (ends, us) = jax.lax.scan(body, x0, jnp.arange(count))
    return jnp.moveaxis(jnp.concatenate([x0[None], ends]), 0, -2), jnp.moveaxis(us, 0, -2)


_KNOWN: WeakValueDictionary[tuple[Any, ...], PlanFunction] = WeakValueDictionary()


def _known_plans(function: PlanFunction, *values: Any) -> Any:
    """Return the arrays of a plan by the same function for equal arguments, since JAX never releases a function."""
    key = (function.problem, function.names, function.certify, *sorted(function.options.items()))
    with suppress(TypeError):  # an option that has no hash, such as an array
        function = _KNOWN.setdefault(key, function)
    return _plans(function, *values)


_FUNCTIONS = Functions(_array, jnp.broadcast_to, _states, _loop, _known_plans)
step, rollout, solve = _FUNCTIONS.step, _FUNCTIONS.rollout, _FUNCTIONS.solve
