"""Counts of compiled programs, against counts by hand and by arithmetic on arrays of ones."""

import jax
import jax.numpy as jnp
import pytest

from crisalad_jax.utils.errors import InputError
from scripts.compile_check.counts import Counts, count
from scripts.compile_check.hlo import Array, parse_arrays, parse_hlo


def counts_of(function, *shapes, dtype=jnp.float32) -> Counts:
    arguments = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    return count(parse_hlo(jax.jit(function).lower(*arguments).compile().as_text()))


def test_a_loop_counts_as_often_as_it_runs():
    def layers(x, weights):
        return jax.lax.scan(lambda x, weight: (jnp.tanh(x @ weight), None), x, weights)[0]

    counts = counts_of(layers, (8, 16), (50, 16, 16))
    assert counts.flops == 50 * 2 * 8 * 16 * 16
    assert counts.unknown_loops == []
    # Each turn reads one layer's weights, and not the stack. What else it moves is a few times as
    # much at most.
    stack = 50 * 16 * 16 * 4
    assert stack < counts.bytes < 10 * stack


def test_a_loop_of_unknown_length_is_named_and_counts_once():
    def until(x, weight):
        return jax.lax.while_loop(lambda x: x.sum() < 1, lambda x: x @ weight, x)

    counts = counts_of(until, (8, 16), (16, 16))
    assert counts.flops == 2 * 8 * 16 * 16
    assert len(counts.unknown_loops) == 1


@pytest.mark.parametrize(
    ("stride", "padding", "dilation", "groups"),
    [(2, "SAME", 1, 1), (2, "VALID", 2, 1), (1, "SAME", 1, 3), (3, "SAME", 1, 1)],
)
def test_a_convolution_counts_the_taps_that_meet_an_input(stride, padding, dilation, groups):
    def convolve(images, kernel):
        return jax.lax.conv_general_dilated(
            images,
            kernel,
            (stride, stride),
            padding,
            rhs_dilation=(dilation, dilation),
            feature_group_count=groups,
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )

    shapes = (2, 9, 11, 3), (3, 3, 3 // groups, 6)
    # Of ones, every multiplication adds 1 to the sum of the result.
    products = float(convolve(*map(jnp.ones, shapes)).sum())
    counts = counts_of(convolve, *shapes)
    assert counts.flops == 2 * products

    # Each gradient has a multiplication for each of the forward pass's; its images, unused, are
    # not computed.
    for argument in (0, 1):
        to_argument = jax.grad(lambda *given: (convolve(*given) ** 2).sum(), argument)
        assert counts_of(to_argument, *shapes).flops == 2 * 2 * products


def test_bytes_are_what_crosses_the_borders_of_a_fusion():
    counts = counts_of(lambda x: jnp.tanh(x) * 2 + 1, (1000,))
    assert counts.bytes == 2 * 4 * 1000
    assert counts.flops == 0


def test_a_slice_reads_and_an_update_writes_itself_alone():
    def change(stack, row):
        return jax.lax.dynamic_update_index_in_dim(stack, row, 3, 0)

    shapes = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((100, 1000), (1000,)))
    text = jax.jit(change, donate_argnums=0).lower(*shapes).compile().as_text()
    assert count(parse_hlo(text)).bytes < 4 * 4 * 1000  # reads and writes a row, not 100 of them
    counts = counts_of(lambda stack: jax.lax.dynamic_index_in_dim(stack, 3) + 1, (100, 1000))
    assert counts.bytes < 4 * 4 * 1000


TPU = """HloModule jit_step, is_scheduled=true

%body (state: (s32[], bf16[24,257,768], bf16[12,768,2304])) -> (s32[], bf16[24,257,768], bf16[12,768,2304]) {
  %state = (s32[]{:T(128)}, bf16[24,257,768]{2,1,0:T(8,128)(2,1)}, bf16[12,768,2304]{2,1,0:T(8,128)(2,1)}) parameter(0)
  %step = s32[]{:T(128)} get-tuple-element(%state), index=0
  %x = bf16[24,257,768]{2,1,0:T(8,128)(2,1)} get-tuple-element(%state), index=1
  %copy-start = (bf16[24,257,768]{2,1,0:T(8,128)(2,1)S(1)}, bf16[24,257,768]{2,1,0:T(8,128)(2,1)}, u32[]{:S(2)}) copy-start(%x)
  %copy-done = bf16[24,257,768]{2,1,0:T(8,128)(2,1)S(1)} copy-done(%copy-start)
  %weights = bf16[12,768,2304]{2,1,0:T(8,128)(2,1)} get-tuple-element(%state), index=2
  %kernel = bf16[24,257,768]{2,1,0:T(8,128)(2,1)} custom-call(%copy-done), custom_call_target="tpu_custom_call", backend_config={"custom_call_config":{"cost_estimate":{"flops":"1000","transcendentals":"7","bytes_accessed":"9"}}}
  ROOT %next = (s32[]{:T(128)}, bf16[24,257,768]{2,1,0:T(8,128)(2,1)}, bf16[12,768,2304]{2,1,0:T(8,128)(2,1)}) tuple(%step, %kernel, %weights)
}

%condition (state.1: (s32[], bf16[24,257,768], bf16[12,768,2304])) -> pred[] {
  %state.1 = (s32[]{:T(128)}, bf16[24,257,768]{2,1,0:T(8,128)(2,1)}, bf16[12,768,2304]{2,1,0:T(8,128)(2,1)}) parameter(0)
  %step.1 = s32[]{:T(128)} get-tuple-element(%state.1), index=0
  %limit = s32[]{:T(128)} constant(12)
  ROOT %lt = pred[]{:T(512)} compare(%step.1, %limit), direction=LT
}

%add (a: bf16[], b: bf16[]) -> bf16[] {
  %a = bf16[] parameter(0)
  %b = bf16[] parameter(1)
  ROOT %sum = bf16[] add(%a, %b)
}

%add.2 (a.2: f32[], b.2: f32[]) -> f32[] {
  %a.2 = f32[] parameter(0)
  %b.2 = f32[] parameter(1)
  ROOT %sum.2 = f32[] add(%a.2, %b.2)
}

%placed (part: bf16[800]) -> bf16[6400] {
  %part.1 = bf16[800]{0:T(1024)} parameter(0)
  %nothing = bf16[] constant(0)
  %zeros = bf16[6400]{0:T(1024)} broadcast(%nothing), dimensions={}
  %place = s32[]{:T(128)} constant(800)
  ROOT %update = bf16[6400]{0:T(1024)} dynamic-update-slice(%zeros, %part.1, %place)
}

%usual (given: f32[1024]) -> f32[1024] {
  %given = f32[1024]{0:T(1024)} parameter(0)
  ROOT %same = f32[1024]{0:T(1024)} negate(%given), backend_config={"window_config":{"estimated_cycles":"40"}}
}

%rare (given.1: f32[1024]) -> f32[1024] {
  %given.1 = f32[1024]{0:T(1024)} parameter(0)
  %once = f32[1024]{0:T(1024)} negate(%given.1), backend_config={"window_config":{"estimated_cycles":"40"}}
  ROOT %twice = f32[1024]{0:T(1024)} negate(%once), backend_config={"window_config":{"estimated_cycles":"40"}}
}

ENTRY %main (x: bf16[24,257,768], w: bf16[12,768,2304], f: f32[1024], g: bf16[800]) -> f32[1024] {
  %x.1 = bf16[24,257,768]{2,1,0:T(8,128)(2,1)} parameter(0)
  %w = bf16[12,768,2304]{2,1,0:T(8,128)(2,1)} parameter(1)
  %f = f32[1024]{0:T(1024)} parameter(2)
  %g = bf16[800]{0:T(1024)} parameter(3)
  %zero = s32[]{:T(128)} constant(0)
  %tuple = (s32[]{:T(128)}, bf16[24,257,768]{2,1,0:T(8,128)(2,1)}, bf16[12,768,2304]{2,1,0:T(8,128)(2,1)}) tuple(%zero, %x.1, %w)
  %while = (s32[]{:T(128)}, bf16[24,257,768]{2,1,0:T(8,128)(2,1)}, bf16[12,768,2304]{2,1,0:T(8,128)(2,1)}) while(%tuple), condition=%condition, body=%body
  %all-reduce = bf16[800]{0:T(1024)} all-reduce(%g), channel_id=1, replica_groups=[2,4]<=[8], to_apply=%add
  %all-gather = f32[8192]{0:T(1024)} all-gather(%f), channel_id=2, replica_groups=mesh['axis_0'=8,'axis_1'=1] {'axis_0'}, dimensions={0}
  %part = f32[1024]{0:T(1024)} reduce-scatter(%all-gather), channel_id=3, replica_groups={{0,1,2,3,4,5,6,7}}, to_apply=%add
  %rounded = bf16[1024]{0:T(1024)} all-reduce(%f), channel_id=4, replica_groups=[1,8]<=[8], to_apply=%add.2
  %own = bf16[6400]{0:T(1024)} fusion(%g), kind=kLoop, calls=%placed
  %gathered = bf16[6400]{0:T(1024)} all-reduce(%own), channel_id=5, replica_groups=[1,8]<=[8], to_apply=%add
  %outfeed = token[] outfeed(%f)
  ROOT %choice = f32[1024]{0:T(1024)} conditional(%zero, %part, %part), branch_computations={%rare, %usual}
}
"""  # noqa: E501


def test_a_text_for_tpus_counted_by_hand():
    counts = count(parse_hlo(TPU), devices=8)
    by_name = {each.name: each for each in counts.work}
    assert counts.collectives == {"all-reduce": 3, "all-gather": 1, "reduce-scatter": 1}
    # The second sum is of float32 numbers, as a TPU prints it, and rounded as it arrives. The third
    # is a gather: each device adds its own part, and zeros.
    assert (counts.bfloat16_sums, counts.fused_attention, counts.host_callbacks) == (1, 1, 1)
    # The limit of the loop is in its condition.
    assert by_name["kernel"].times == 12
    assert by_name["kernel"].flops == {"bf16": 1000}
    assert by_name["kernel"].cycles is None
    # 257 rows are padded to 264; what is on the chip does not count.
    padded = 24 * 264 * 768 * 2
    assert by_name["copy-start"].bytes == padded
    assert by_name["kernel"].bytes == padded
    # Around a ring of 4, each sends twice three quarters of what it adds; of the 800 numbers, 1024
    # are in memory. A gather of 8 passes on seven parts, and a scatter seven eighths.
    assert by_name["all-reduce"].sent == 2 * 3 * 1024 * 2 // 4
    assert by_name["all-gather"].sent == 7 * 1024 * 4
    assert by_name["part"].sent == 7 * 1024 * 4
    # The cheaper branch counts, and its cycles.
    assert by_name["same"].cycles == 40
    assert not by_name.keys() & {"once", "twice", "choice"}


GPU = """HloModule jit_step, is_scheduled=true

ENTRY %main (x: bf16[2,257,12,64], a: f32[64,128], b: f32[128,32]) -> f32[64,32] {
  %x = bf16[2,257,12,64]{3,2,1,0} parameter(0)
  %a = f32[64,128]{1,0} parameter(1)
  %b = f32[128,32]{1,0} parameter(2)
  %forward = (bf16[2,12,257,64]{3,1,2,0}, f32[2,12,257]{2,1,0}, u8[0]{0}) custom-call(%x, %x, %x), custom_call_target="__cudnn$fmhaSoftmax", backend_config={"cudnn_fmha_backend_config":{"fmha_scale":0.125}}
  %o = bf16[2,12,257,64]{3,1,2,0} get-tuple-element(%forward), index=0
  %l = f32[2,12,257]{2,1,0} get-tuple-element(%forward), index=1
  %backward = (bf16[2,12,257,64]{3,1,2,0}, bf16[2,12,257,64]{3,1,2,0}, bf16[2,12,257,64]{3,1,2,0}, u8[0]{0}) custom-call(%x, %x, %x, %l, %x, %o), custom_call_target="__cudnn$fmhaSoftmaxBackward", backend_config={"cudnn_fmha_backend_config":{"fmha_scale":0.125}}
  %product = (f32[64,32]{1,0}, s8[33554432]{0}) custom-call(%a, %b), custom_call_target="__cublas$gemm", backend_config={"gemm_backend_config":{"dot_dimension_numbers":{"lhs_contracting_dimensions":["1"],"rhs_contracting_dimensions":["0"]},"precision_config":{"operand_precision":["HIGHEST","HIGHEST"]}}}
  %gathered = (f32[64,32]{1,0}, f32[512,32]{1,0}) all-gather-start(%b), dimensions={0}
  %all = f32[512,32]{1,0} all-gather-done(%gathered)
  ROOT %result = f32[64,32]{1,0} get-tuple-element(%product), index=0
}
"""  # noqa: E501


def test_a_text_for_gpus_counted_by_hand():
    counts = count(parse_hlo(GPU), devices=8)
    by_name = {each.name: each for each in counts.work}
    product = 2 * 2 * 12 * 257 * 257 * 64
    assert by_name["forward"].flops == {"bf16": 2 * product}
    # Scores, their cotangent, and the cotangents of queries, keys and values.
    assert by_name["backward"].flops == {"bf16": 5 * product}
    assert by_name["product"].flops == {"f32:highest": 2 * 64 * 32 * 128}
    # Queries, keys and values are one array, read once.
    assert by_name["forward"].bytes == 2 * 2 * (2 * 257 * 12 * 64) + 4 * 2 * 12 * 257
    # The library's work space is no result.
    assert by_name["product"].bytes == 4 * (64 * 128 + 128 * 32 + 64 * 32)
    assert by_name["gathered"].bytes == 4 * (64 * 32 + 512 * 32)
    assert counts.collectives == {"all-gather": 1}
    assert counts.fused_attention == 2


@pytest.mark.parametrize(
    ("text", "bytes_", "on_chip"),
    [
        ("f32[3,5]{1,0}", 60, False),
        ("f32[3,5]{1,0:T(8,128)}", 4 * 8 * 128, False),
        ("bf16[2,3,5]{1,2,0:T(8,128)(2,1)S(1)}", 2 * 2 * 8 * 128, True),
        ("pred[7]{0:T(512)}", 512, False),
        ("s4[6]{0}", 3, False),
        ("token[]", 0, False),
        ("f32[4]{0:S(5)}", 16, False),
    ],
)
def test_arrays_in_memory(text, bytes_, on_chip):
    (array,) = parse_arrays(text)
    assert (array.bytes, array.on_chip) == (bytes_, on_chip)


def test_types_of_tuples_are_read_in_order():
    arrays = parse_arrays("(f32[2]{0}, /*index=1*/(bf16[3,4]{1,0}), u32[])")
    assert [each.dims for each in arrays] == [(2,), (3, 4), ()]
    assert arrays[0] == Array("f32", (2,), "0")


def test_other_texts_are_refused():
    with pytest.raises(InputError, match="found no ENTRY computation, expected the text"):
        parse_hlo("module @jit_step {}")
