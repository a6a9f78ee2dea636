"""Reading a compiled program: stages by named scopes, arithmetic and traffic as counted by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from jaxmap.models.architecture import folded, torch_architecture
from jaxmap.models.backbones import InvertedResidual
from jaxmap.native.build import has_kernel
from jaxmap.profiling.program import OTHER, STAGES, Operation, read_program, stage_of

SCOPES = ("first", "second")


def operations(function, *arguments, donate=()) -> dict[str, Operation]:
    text = jax.jit(function, donate_argnums=donate).lower(*arguments).compile().as_text()
    return read_program(text, SCOPES)


def total(program: dict[str, Operation], stage: str) -> tuple[float, float]:
    """Flops and bytes of a stage."""
    parts = [one for one in program.values() if one.stage == stage]
    return sum(one.flops for one in parts), sum(one.bytes for one in parts)


def test_a_product_of_matrices_is_counted_by_hand():
    def product(one, other):
        with jax.named_scope("first"):
            return one @ other

    flops, moved = total(operations(product, jnp.ones((64, 32)), jnp.ones((32, 48))), "first")
    assert flops == 2 * 64 * 32 * 48
    assert moved == 4 * (64 * 32 + 32 * 48 + 64 * 48)


def test_elementwise_work_is_counted_once_for_each_element():
    def twice(values):
        with jax.named_scope("first"):
            return jnp.sin(values) * 3.0 + 1.0

    program = operations(twice, jnp.ones((100, 30)))
    flops, moved = total(program, "first")
    assert flops == 3 * 3000
    assert moved == pytest.approx(2 * 4 * 3000, abs=16)
    assert len(program) == 1


def test_what_is_changed_in_place_moves_only_what_changes():
    def paste(whole, part, place):
        with jax.named_scope("second"):
            return jax.lax.dynamic_update_slice(whole, part + 1.0, (place, 0))

    program = operations(paste, jnp.ones((4096, 128)), jnp.ones((8, 128)), jnp.int32(3), donate=0)
    _, moved = total(program, "second")
    assert moved < 10 * 4 * 8 * 128


def test_a_scatter_moves_what_it_hits():
    def add(grid, places, values):
        with jax.named_scope("second"):
            return grid.at[places].add(values, mode="drop")

    program = operations(add, jnp.zeros(1 << 20), jnp.arange(1000), jnp.ones(1000), donate=0)
    _, moved = total(program, "second")
    assert 3 * 4 * 1000 <= moved < 20 * 4 * 1000


def test_stages_are_told_apart_and_loops_are_not_counted_beside_what_they_run():
    def both(values):
        with jax.named_scope("first"):
            values = jax.lax.fori_loop(0, 5, lambda _, one: jnp.sort(jnp.cos(one)), values)
        with jax.named_scope("second"):
            return jnp.cumsum(values @ values)

    program = operations(both, jnp.ones((40, 40)))
    assert {one.stage for one in program.values()} >= set(SCOPES)
    assert not [name for name in program if name.startswith("while")]
    assert total(program, "second")[0] >= 2 * 40**3


def test_the_outermost_scope_counts():
    assert stage_of("jit(step)/first/jit(inverse)/second/mul", SCOPES) == "first"
    assert stage_of("jit(step)/mul", SCOPES) is None
    assert stage_of("", SCOPES) is None


@pytest.mark.parametrize(
    "text", ["", "HloModule nothing", "ENTRY %main (a: f32[]) -> f32[] {\n  %a = \n}\n", "\x00\xff"]
)
def test_a_text_that_is_no_program_has_no_operations(text):
    assert read_program(text) == {}


def test_names_of_arrays_are_no_scopes():
    """A parameter whose name is that of a stage is not in it."""

    def plain(first):
        return first * 2.0

    program = operations(plain, jnp.ones(8))
    assert {one.stage for one in program.values()} == {OTHER}
    assert OTHER not in STAGES
    assert np.isfinite([one.flops for one in program.values()]).all()


def test_the_compiled_kernel_is_counted_by_hand():
    if not has_kernel():
        pytest.skip("no C++ compiler, or no CPU")
    unit = InvertedResidual(4, 8, 3, 2, 1, folded(torch_architecture("mobilenet_v2", ("one", "two"))))
    nnx.update(unit, jax.tree.map(jnp.ones_like, nnx.state(unit)))

    def apply(images):
        with jax.named_scope("first"):
            return unit(images)

    flops, moved = total(operations(apply, jnp.ones((2, 16, 12, 4))), "first")
    expand, depthwise, project = 2 * 16 * 12 * 4 * 12, 2 * 8 * 6 * 12 * 9, 2 * 8 * 6 * 12 * 8
    assert flops == 2 * (expand + depthwise + project)
    assert moved == 4 * (2 * 16 * 12 * 4 + 2 * 8 * 6 * 8 + (4 * 12 + 12) + (9 * 12 + 12) + (12 * 8 + 8))
