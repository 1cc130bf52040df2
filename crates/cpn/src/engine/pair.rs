//! Pairs of numbers in bfloat16, the upper half of a float32, which some processors multiply twice as many of.

#![expect(unsafe_code, reason = "instructions that not every processor has")]

use super::factor::Factor;
use super::lanes::{Aligned, grown};
use bytemuck::{Pod, Zeroable, cast, try_cast};
use pulp::x86::{V3, V4};
use pulp::{Arch, Scalar, Simd, WithSimd};
use std::arch::x86_64::{__m512, __m512bh, _mm512_dpbf16_ps};
use std::mem::transmute;

/// The bits of an upper half.
const UPPER: u32 = 0xffff_0000;

/// Two numbers, the first in the lower half.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub struct Pair(u32);

impl Pair {
    /// The instructions, if this processor has them for registers of 512 bits.
    fn instructions() -> Option<V4> {
        if is_x86_feature_detected!("avx512bf16") { V4::try_new() } else { None }
    }

    /// Whether pairs are multiplied faster than their numbers: without the instructions it takes several others.
    pub fn is_fast() -> bool {
        Self::instructions().is_some()
    }
}

impl Factor for Pair {
    type Sum = f32;
    type Lanes<S: Simd> = S::u32s;
    const NUMBERS: usize = 2;
    const ZERO: Self = Self(0);

    #[inline(always)]
    fn splat<S: Simd>(simd: S, value: Self) -> S::u32s {
        simd.splat_u32s(value.0)
    }

    #[inline(always)]
    fn load<S: Simd>(simd: S, slice: &[Self]) -> S::u32s {
        let slice: &[u32] = bytemuck::cast_slice(slice);
        match slice.get(..S::U32_LANES).map(S::as_simd_u32s) {
            Some((&[lanes], _)) => lanes,
            _ => simd.partial_load_u32s(slice),
        }
    }

    #[inline(always)]
    fn mul_add<S: Simd>(simd: S, a: S::u32s, b: S::u32s, c: S::f32s) -> S::f32s {
        if let (Ok(a), Ok(b), Ok(c)) = (try_cast(a), try_cast(b), try_cast(c)) {
            return cast(multiply(a, b, c));
        }
        let upper = |x| simd.transmute_f32s_u32s(simd.and_u32s(x, simd.splat_u32s(UPPER)));
        let lower = |x| simd.transmute_f32s_u32s(simd.wrapping_dyn_shl_u32s(x, simd.splat_u32s(16)));
        simd.mul_add_f32s(lower(a), lower(b), simd.mul_add_f32s(upper(a), upper(b), c))
    }

    /// By registers of 512 bits only with the instructions for them.
    #[inline(always)]
    fn dispatch<W: WithSimd>(kernel: W) -> W::Output {
        match (Self::instructions(), V3::try_new()) {
            // SAFETY: the processor has the instructions.
            (Some(simd), _) => unsafe { natively(simd, kernel) },
            (None, Some(simd)) => Simd::vectorize(simd, kernel),
            (None, None) => Simd::vectorize(Scalar, kernel),
        }
    }

    fn along<'a>(numbers: &'a [f32], room: &'a mut Aligned<Self>) -> &'a [Self] {
        let pairs = grown(room, numbers.len() / 2);
        Arch::new().dispatch(Along { numbers, halves: bytemuck::cast_slice_mut(pairs) });
        pairs
    }

    fn across<'a>(numbers: &'a [f32], columns: usize, room: &'a mut Aligned<Self>) -> &'a [Self] {
        let pairs = grown(room, (numbers.len() / columns).div_ceil(2) * columns);
        Arch::new().dispatch(Across { numbers, columns, pairs });
        pairs
    }
}

/// a b + c in registers of 512 bits.
#[inline(always)]
fn multiply(a: [u32; 16], b: [u32; 16], c: [f32; 16]) -> [f32; 16] {
    // SAFETY: all are 512 bits, any of which are numbers; only `natively` gives such registers to a kernel of pairs.
    unsafe {
        let [a, b] = [transmute::<[u32; 16], __m512bh>(a), transmute::<[u32; 16], __m512bh>(b)];
        transmute::<__m512, [f32; 16]>(_mm512_dpbf16_ps(transmute::<[f32; 16], __m512>(c), a, b))
    }
}

/// Runs a kernel with the instructions of [`V4`] and those for bfloat16.
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512bf16,fma,bmi1,bmi2,lzcnt,popcnt")]
fn natively<W: WithSimd>(simd: V4, kernel: W) -> W::Output {
    kernel.with_simd(simd)
}

/// The nearest bfloat16 in the upper half, from between two the larger, and anything in the lower. What an operation leaves as
/// not a number stays so.
#[inline(always)]
fn rounded(number: f32) -> u32 {
    number.to_bits().wrapping_add(0x8000)
}

struct Along<'a> {
    numbers: &'a [f32],
    halves: &'a mut [u16],
}

impl WithSimd for Along<'_> {
    type Output = ();

    // As in `Across`, nothing names a register; the compiler finds them, as wide as the dispatch says there are.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for (half, number) in self.halves.iter_mut().zip(self.numbers) {
            *half = (rounded(*number) >> 16) as u16;
        }
    }
}

struct Across<'a> {
    numbers: &'a [f32],
    columns: usize,
    pairs: &'a mut [Pair],
}

impl WithSimd for Across<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Self { numbers, columns, pairs } = self;
        let rows = numbers.chunks_exact(2 * columns);
        let (last, mut pairs) = (rows.remainder(), pairs.chunks_exact_mut(columns));
        for (rows, pairs) in rows.zip(&mut pairs) {
            let (first, second) = rows.split_at(columns);
            for (pair, (first, second)) in pairs.iter_mut().zip(first.iter().zip(second)) {
                *pair = Pair(rounded(*first) >> 16 | rounded(*second) & UPPER);
            }
        }
        for (pair, number) in pairs.flatten().zip(last) {
            *pair = Pair(rounded(*number) >> 16);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::lanes::zeros;
    use super::super::matrix::{Matrix, Panels};
    use super::super::product::{Left, multiply};
    use super::*;

    /// Numbers from -1 to 1, none of which fits bfloat16.
    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 9973) as f32 / 4986.5 - 1.0001).collect()
    }

    fn nearest(number: f32) -> f64 {
        f32::from_bits(rounded(number) & UPPER).into()
    }

    /// a `[rows, inner]` times b `[inner, columns]`, both rounded.
    fn expected(a: &[f32], b: &[f32], columns: usize) -> Vec<f64> {
        let inner = b.len() / columns;
        let columns = turned(b, columns);
        let sum = |row: &[f32], column: &[f32]| row.iter().zip(column).map(|(a, b)| nearest(*a) * nearest(*b)).sum();
        a.chunks_exact(inner)
            .flat_map(|row| columns.chunks_exact(inner).map(|column| sum(row, column)).collect::<Vec<_>>())
            .collect()
    }

    fn turned(values: &[f32], columns: usize) -> Vec<f32> {
        (0..columns).flat_map(|c| values.iter().skip(c).step_by(columns).copied()).collect()
    }

    fn assert_close(ours: &[f32], expected: &[f64], what: &str) {
        for (ours, expected) in ours.iter().zip(expected) {
            assert!((f64::from(*ours) - expected).abs() < 1e-4, "{what}: {ours} for {expected}");
        }
    }

    #[test]
    fn products_are_those_of_rounded_numbers() {
        for (rows, inner, columns) in [(1, 2, 1), (3, 48, 32), (17, 130, 33), (64, 256, 64), (1, 512, 70)] {
            let (a, b) = (numbers(rows * inner, 1), numbers(inner * columns, 2));
            let expected = expected(&a, &b, columns);
            let (a_turned, b_turned) = (turned(&a, inner), turned(&b, columns));
            let mut rooms = [(); 4].map(|()| zeros(0));
            let [along, panels, across, down] = &mut rooms;
            let (along, across) = (Pair::along(&a, along), Pair::across(&b, columns, across));
            let panels = Panels::transposed(Pair::along(&b_turned, panels), inner / 2);
            let lefts = [Left::Rows(along), Left::Turned(Pair::across(&a_turned, rows, down))];
            for (left, b) in lefts.into_iter().flat_map(|a| [(a, panels.matrix()), (a, Matrix::new(across, columns))]) {
                let mut c = vec![f32::NAN; rows * columns];
                multiply(false, &mut c, left, b);
                assert_close(&c, &expected, &format!("{rows} x {inner} x {columns}"));
            }
        }
    }

    struct MultiplyAdd<'a>([&'a [Pair]; 2], &'a mut [f32]);

    impl WithSimd for MultiplyAdd<'_> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            let Self([a, b], c) = self;
            let count = S::F32_LANES;
            for (c, (a, b)) in c.chunks_mut(count).zip(a.chunks(count).zip(b.chunks(count))) {
                let sums = Pair::mul_add(simd, Pair::load(simd, a), Pair::load(simd, b), simd.partial_load_f32s(c));
                simd.partial_store_f32s(c, sums);
            }
        }
    }

    #[test]
    fn without_instructions_they_are_the_same() {
        let (a, b) = (numbers(38, 1), numbers(38, 2));
        let mut rooms = [zeros(0), zeros(0)];
        let [in_a, in_b] = &mut rooms;
        let pairs = [Pair::along(&a, in_a), Pair::along(&b, in_b)];
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
        Pair::dispatch(MultiplyAdd(pairs, &mut sums));
        assert_close(&sums, &expected, "as dispatched");
    }

    #[test]
    fn rounding_is_to_the_nearest_and_keeps_what_is_not_a_number() {
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
