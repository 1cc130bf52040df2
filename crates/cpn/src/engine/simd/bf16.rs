//! Pairs of bfloat16, the upper half of a float32: an operand with twice the throughput of float32 on processors with AVX512-BF16.

#![expect(unsafe_code, reason = "instructions that not every processor has")]

use super::buffer::{AlignedVec, resize};
use super::element::Operand;
use bytemuck::{Pod, Zeroable, cast, try_cast};
use pulp::x86::{V3, V4};
use pulp::{Arch, Scalar, Simd, WithSimd};
use std::arch::x86_64::{__m512, __m512bh, _mm512_dpbf16_ps};
use std::mem::transmute;

/// Mask of a word's upper half.
const UPPER: u32 = 0xffff_0000;

/// A pair of bfloat16 in 32 bits, the first in the lower half.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub struct Bf16x2(u32);

impl Bf16x2 {
    /// The token of AVX512-BF16 with 512-bit registers; `None` on processors without it.
    fn instructions() -> Option<V4> {
        if is_x86_feature_detected!("avx512bf16") { V4::try_new() } else { None }
    }

    /// True on processors with AVX512-BF16, where pairs are multiplied faster than float32. Elsewhere a product takes several
    /// instructions.
    pub fn is_fast() -> bool {
        Self::instructions().is_some()
    }
}

impl Operand for Bf16x2 {
    type Sum = f32;
    type Register<S: Simd> = S::u32s;
    const PACK: usize = 2;
    const ZERO: Self = Self(0);

    #[inline(always)]
    fn splat<S: Simd>(simd: S, value: Self) -> S::u32s {
        simd.splat_u32s(value.0)
    }

    #[inline(always)]
    fn load<S: Simd>(simd: S, slice: &[Self]) -> S::u32s {
        let slice: &[u32] = bytemuck::cast_slice(slice);
        match slice.get(..S::U32_LANES).map(S::as_simd_u32s) {
            Some((&[register], _)) => register,
            _ => simd.partial_load_u32s(slice),
        }
    }

    #[inline(always)]
    fn mul_add<S: Simd>(simd: S, a: S::u32s, b: S::u32s, c: S::f32s) -> S::f32s {
        if let (Ok(a), Ok(b), Ok(c)) = (try_cast(a), try_cast(b), try_cast(c)) {
            return cast(dot_add(a, b, c));
        }
        let upper = |x| simd.transmute_f32s_u32s(simd.and_u32s(x, simd.splat_u32s(UPPER)));
        let lower = |x| simd.transmute_f32s_u32s(simd.wrapping_dyn_shl_u32s(x, simd.splat_u32s(16)));
        simd.mul_add_f32s(lower(a), lower(b), simd.mul_add_f32s(upper(a), upper(b), c))
    }

    /// 512-bit registers only with AVX512-BF16, as `dot_add` requires.
    #[inline(always)]
    fn dispatch<W: WithSimd>(kernel: W) -> W::Output {
        match (Self::instructions(), V3::try_new()) {
            // SAFETY: the processor has the instructions.
            (Some(simd), _) => unsafe { run_native(simd, kernel) },
            (None, Some(simd)) => Simd::vectorize(simd, kernel),
            (None, None) => Simd::vectorize(Scalar, kernel),
        }
    }

    fn pack_along_k<'a>(numbers: &'a [f32], workspace: &'a mut AlignedVec<Self>) -> &'a [Self] {
        let pairs = resize(workspace, numbers.len() / 2);
        Arch::new().dispatch(PackAlongK { numbers, halves: bytemuck::cast_slice_mut(pairs) });
        pairs
    }

    fn pack_row_pairs<'a>(numbers: &'a [f32], columns: usize, workspace: &'a mut AlignedVec<Self>) -> &'a [Self] {
        let pairs = resize(workspace, (numbers.len() / columns).div_ceil(2) * columns);
        Arch::new().dispatch(PackRowPairs { numbers, columns, pairs });
        pairs
    }
}

/// a b + c in 512-bit registers, with both products of each pair.
#[inline(always)]
fn dot_add(a: [u32; 16], b: [u32; 16], c: [f32; 16]) -> [f32; 16] {
    // SAFETY: all types have 512 bits and no invalid values; only `run_native` calls a kernel of pairs with such registers.
    unsafe {
        let [a, b] = [transmute::<[u32; 16], __m512bh>(a), transmute::<[u32; 16], __m512bh>(b)];
        transmute::<__m512, [f32; 16]>(_mm512_dpbf16_ps(transmute::<[f32; 16], __m512>(c), a, b))
    }
}

/// Runs a kernel with the instructions of [`V4`] and AVX512-BF16.
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512bf16,fma,bmi1,bmi2,lzcnt,popcnt")]
fn run_native<W: WithSimd>(simd: V4, kernel: W) -> W::Output {
    kernel.with_simd(simd)
}

/// Rounding to the nearest bfloat16, in the upper half, with ties away from zero; the lower half is undefined. A NaN produced by an
/// operation stays NaN.
#[inline(always)]
fn rounded(number: f32) -> u32 {
    number.to_bits().wrapping_add(0x8000)
}

/// [`Operand::pack_along_k`].
struct PackAlongK<'a> {
    numbers: &'a [f32],
    halves: &'a mut [u16],
}

impl WithSimd for PackAlongK<'_> {
    type Output = ();

    // As in `PackRowPairs`, the compiler vectorises the loop for the instructions of the dispatch.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for (half, number) in self.halves.iter_mut().zip(self.numbers) {
            *half = (rounded(*number) >> 16) as u16;
        }
    }
}

/// [`Operand::pack_row_pairs`].
struct PackRowPairs<'a> {
    numbers: &'a [f32],
    columns: usize,
    pairs: &'a mut [Bf16x2],
}

impl WithSimd for PackRowPairs<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Self { numbers, columns, pairs } = self;
        let rows = numbers.chunks_exact(2 * columns);
        let (last, mut pairs) = (rows.remainder(), pairs.chunks_exact_mut(columns));
        for (rows, pairs) in rows.zip(&mut pairs) {
            let (first, second) = rows.split_at(columns);
            for (pair, (first, second)) in pairs.iter_mut().zip(first.iter().zip(second)) {
                *pair = Bf16x2(rounded(*first) >> 16 | rounded(*second) & UPPER);
            }
        }
        for (pair, number) in pairs.flatten().zip(last) {
            *pair = Bf16x2(rounded(*number) >> 16);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::buffer::zeros;
    use super::*;

    /// Numbers from -1 to 1, none exact in bfloat16.
    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 9973) as f32 / 4986.5 - 1.0001).collect()
    }

    fn nearest(number: f32) -> f64 {
        f32::from_bits(rounded(number) & UPPER).into()
    }

    fn assert_close(ours: &[f32], expected: &[f64], what: &str) {
        for (ours, expected) in ours.iter().zip(expected) {
            assert!((f64::from(*ours) - expected).abs() < 1e-4, "{what}: {ours} for {expected}");
        }
    }

    struct MultiplyAdd<'a>([&'a [Bf16x2]; 2], &'a mut [f32]);

    impl WithSimd for MultiplyAdd<'_> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            let Self([a, b], c) = self;
            let count = S::F32_LANES;
            for (c, (a, b)) in c.chunks_mut(count).zip(a.chunks(count).zip(b.chunks(count))) {
                let sums =
                    Bf16x2::mul_add(simd, Bf16x2::load(simd, a), Bf16x2::load(simd, b), simd.partial_load_f32s(c));
                simd.partial_store_f32s(c, sums);
            }
        }
    }

    #[test]
    fn products_are_equal_with_and_without_the_instructions() {
        let (a, b) = (numbers(38, 1), numbers(38, 2));
        let mut workspaces = [zeros(0), zeros(0)];
        let [in_a, in_b] = &mut workspaces;
        let pairs = [Bf16x2::pack_along_k(&a, in_a), Bf16x2::pack_along_k(&b, in_b)];
        let products = a
            .chunks(2)
            .zip(b.chunks(2))
            .map(|(a, b)| 0.5 + nearest(a[0]) * nearest(b[0]) + nearest(a[1]) * nearest(b[1]));
        let expected: Vec<_> = products.collect();
        let mut sums = [0.5; 19];
        Simd::vectorize(Scalar, MultiplyAdd(pairs, &mut sums));
        assert_close(&sums, &expected, "one by one");
        if let Some(simd) = V3::try_new() {
            let mut sums = [0.5; 19];
            Simd::vectorize(simd, MultiplyAdd(pairs, &mut sums));
            assert_close(&sums, &expected, "eight at once");
        }
        let mut sums = [0.5; 19];
        Bf16x2::dispatch(MultiplyAdd(pairs, &mut sums));
        assert_close(&sums, &expected, "as dispatched");
    }

    #[test]
    fn row_pairs_hold_two_rows_and_zeros_below_an_odd_one() {
        let values = numbers(15, 3);
        let mut workspace = zeros(0);
        let pairs = Bf16x2::pack_row_pairs(&values, 5, &mut workspace);
        let halves = |pair: &Bf16x2| [pair.0 << 16, pair.0 & UPPER].map(|bits| f64::from(f32::from_bits(bits)));
        for (i, pair) in pairs.iter().enumerate() {
            let (row, column) = (i / 5 * 2, i % 5);
            let below = values.get((row + 1) * 5 + column).map_or(0.0, |number| nearest(*number));
            assert_eq!(halves(pair), [nearest(values[row * 5 + column]), below], "pair {i}");
        }
        assert_eq!(pairs.len(), 10);
    }

    #[test]
    fn rounding_is_to_the_nearest_and_keeps_nan() {
        for (number, expected) in [
            (1.0, 1.0),
            (1.0 + 0.99 / 256.0, 1.0),
            (-1.0 - 1.0 / 256.0, -1.0 - 1.0 / 128.0),
            (-3.01, -3.015_625),
            (f32::INFINITY, f64::INFINITY),
        ] {
            assert_eq!(nearest(number), expected, "{number}");
        }
        assert!(nearest(f32::NAN).is_nan() && nearest(-(f32::INFINITY - f32::INFINITY)).is_nan());
    }
}
