"""Which form of an operation runs: the one that is set explicitly, or else the one for the platform of the program."""

import contextlib
import functools
import os
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar, get_args

import jax
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from l2dgs_jax.errors import UserError
from l2dgs_jax.kernels.compilation import TESTED, VERSION

Form = Literal["reference", "cpu", "accelerator"]
FORMS: tuple[Form, ...] = get_args(Form)
ENV_VARIABLE = "L2DGS_JAX_KERNELS"  # sets the form for a whole process

T = TypeVar("T")


# A user context is part of the key under which jax caches traced and compiled functions.
_UNSET = "unset"
_setting = jax.make_user_context(default_value=_UNSET)


def use_kernels(form: str | None) -> contextlib.AbstractContextManager[None]:
    """A context in which every operation runs in this form, whatever the platform; None: the platform decides.

    The environment variable L2DGS_JAX_KERNELS sets the same for a whole process.

    Args:
        form: "reference", "cpu" or "accelerator".

    Raises:
        ValueError: there is no such form.
    """
    if form not in (None, *FORMS):
        raise ValueError(f"kernels in the form {form!r}; expected one of {', '.join(FORMS)}, or None")
    return _setting(form)


def chosen_form() -> Form | None:
    """The form that is set explicitly, by `use_kernels` or the environment variable; None if there is none.

    Raises:
        UserError: the environment variable names no form.
    """
    return _from_environment() if _setting.value == _UNSET else _setting.value


@functools.cache
def _from_environment() -> Form | None:
    value = os.environ.get(ENV_VARIABLE) or None
    if value not in (None, *FORMS):
        raise UserError(f"{ENV_VARIABLE} is {value!r}; expected one of {', '.join(FORMS)}, or nothing")
    return value


def functions_by_form(
    name: str, *, reference: Any, cpu: Any, accelerator: Any, **static: Any
) -> dict[str, Callable[..., Any]]:
    """Arguments for `by_form`: the function `name` of each form's module, with `static` keyword arguments bound."""
    modules = {"reference": reference, "cpu": cpu, "accelerator": accelerator}
    return {form: functools.partial(getattr(module, name), **static) for form, module in modules.items()}


def by_form(
    *arguments: Any, reference: Callable[..., T], cpu: Callable[..., T], accelerator: Callable[..., T], like: Any
) -> T:
    """Call one of three functions that compute the same values.

    Without an explicit setting, the choice is made when the program is lowered for a platform: programs for CPUs
    contain `cpu`, if it was tested with this version of the compiler, and all others `accelerator`. The call then
    carries no gradients, so callers define their own, and cannot be used in a `jax.shard_map` with `check_vma`.

    Args:
        *arguments: PyTrees of arrays.
        reference: the plain form.
        cpu: the form for CPUs.
        accelerator: the form for everything else.
        like: shapes and types of the result, a PyTree of arrays or `jax.ShapeDtypeStruct`s.
    """
    form = chosen_form()
    if form is not None:
        return {"reference": reference, "cpu": cpu, "accelerator": accelerator}[form](*arguments)
    leaves, structure = jax.tree.flatten(arguments)
    shapes, result = jax.tree.flatten(like)
    # Cotangents of integers have type float0, which a program cannot take as an argument.
    nothing = jax.dtypes.float0
    constants = [np.zeros(leaf.shape, nothing) if leaf.dtype == nothing else None for leaf in leaves]

    def on_leaves(function: Callable[..., T]) -> Callable[..., list[Any]]:
        def call(*taken: Any) -> list[Any]:
            rest = iter(taken)
            every = [next(rest) if constant is None else constant for constant in constants]
            return jax.tree.leaves(function(*jax.tree.unflatten(structure, every)))

        return call

    results = _by_platform.bind(
        *(leaf for leaf, constant in zip(leaves, constants, strict=True) if constant is None),
        cpu=on_leaves(cpu),
        accelerator=on_leaves(accelerator),
        shapes=tuple((tuple(x.shape), x.dtype) for x in shapes),
    )
    return jax.tree.unflatten(result, results)


Shapes = tuple[tuple[tuple[int, ...], Any], ...]

_by_platform = Primitive("kernel_by_platform")
_by_platform.multiple_results = True


@_by_platform.def_abstract_eval
def _shapes(*_: Any, cpu: Callable, accelerator: Callable, shapes: Shapes) -> list[Any]:
    del cpu, accelerator
    return [jax.core.ShapedArray(shape, dtype) for shape, dtype in shapes]


@_by_platform.def_impl
def _run(*leaves: Any, cpu: Callable, accelerator: Callable, shapes: Shapes) -> list[Any]:
    del shapes
    platforms = {device.platform for leaf in leaves for device in getattr(leaf, "devices", set)()}
    platform = min(platforms, default=jax.default_backend())
    return (_for_cpu(cpu, accelerator) if platform == "cpu" else accelerator)(*leaves)


def _batch(
    leaves: Sequence[Any], axes: Sequence[Any], *, cpu: Callable, accelerator: Callable, shapes: Shapes
) -> tuple[list[Any], list[int]]:
    size = next(x.shape[axis] for x, axis in zip(leaves, axes, strict=True) if axis is not None)
    in_axes = tuple(axes)  # None where all members share an argument

    def batched(function: Callable) -> Callable:
        return jax.vmap(function, in_axes=in_axes, axis_size=size)

    results = _by_platform.bind(
        *leaves,
        cpu=batched(cpu),
        accelerator=batched(accelerator),
        shapes=tuple(((size, *shape), dtype) for shape, dtype in shapes),
    )
    return results, [0] * len(results)


batching.primitive_batchers[_by_platform] = _batch


def _lower_for_cpu(context: Any, *operands: Any, cpu: Callable, accelerator: Callable, shapes: Shapes) -> Any:
    del shapes
    return mlir.lower_fun(_for_cpu(cpu, accelerator))(context, *operands)


def _lower(context: Any, *operands: Any, cpu: Callable, accelerator: Callable, shapes: Shapes) -> Any:
    del cpu, shapes
    return mlir.lower_fun(accelerator)(context, *operands)


mlir.register_lowering(_by_platform, _lower)
mlir.register_lowering(_by_platform, _lower_for_cpu, platform="cpu")


def _for_cpu(cpu: Callable, accelerator: Callable) -> Callable:
    if TESTED:
        return cpu
    _warn_of_untested_compiler()
    return accelerator


@functools.cache
def _warn_of_untested_compiler() -> None:
    warnings.warn(
        f"jaxlib {VERSION} was not tried with the fast kernels for CPUs, so this runs several times as slowly as it "
        "could; expected jaxlib 0.10",
        RuntimeWarning,
        stacklevel=2,
    )
