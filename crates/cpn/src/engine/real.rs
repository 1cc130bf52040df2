//! The numbers that the engine is written in: float32 to train with, float64 to check it by.

use super::factor::Factor;
use super::lanes::Aligned;
use super::pair::Pair;
use pulp::Simd;
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

/// A floating-point number, and registers full of it.
pub trait Real:
    Factor<Sum = Self>
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + Sum
{
    /// What products may multiply in its place, more coarsely.
    type Half: Factor<Sum = Self>;
    /// 1.
    const ONE: Self;

    /// A count as a number.
    fn count(n: usize) -> Self;
    /// A whole number.
    fn from_u8(value: u8) -> Self;
    /// The nearest number.
    fn from_f64(value: f64) -> Self;
    /// The hyperbolic tangent.
    fn tanh(self) -> Self;
    /// The square root.
    fn sqrt(self) -> Self;
    /// 1 / (1 + e^-x).
    fn sigmoid(self) -> Self;

    /// Writes over the first numbers of a slice, as many as it has.
    fn store<S: Simd>(simd: S, slice: &mut [Self], lanes: Self::Lanes<S>);
    /// As many whole registers as a slice fills.
    fn registers<S: Simd>(simd: S, slice: &[Self]) -> &[Self::Lanes<S>];
    /// The same, to be written.
    fn registers_mut<S: Simd>(simd: S, slice: &mut [Self]) -> &mut [Self::Lanes<S>];
    /// a + b.
    fn add_lanes<S: Simd>(simd: S, a: Self::Lanes<S>, b: Self::Lanes<S>) -> Self::Lanes<S>;
    /// a - b.
    fn sub_lanes<S: Simd>(simd: S, a: Self::Lanes<S>, b: Self::Lanes<S>) -> Self::Lanes<S>;
    /// a b.
    fn mul_lanes<S: Simd>(simd: S, a: Self::Lanes<S>, b: Self::Lanes<S>) -> Self::Lanes<S>;
    /// The larger of a and b; b where one is not a number.
    fn max_lanes<S: Simd>(simd: S, a: Self::Lanes<S>, b: Self::Lanes<S>) -> Self::Lanes<S>;
    /// The sum of all.
    fn sum_lanes<S: Simd>(simd: S, lanes: Self::Lanes<S>) -> Self;
    /// σ of each.
    fn sigmoids<S: Simd>(simd: S, lanes: Self::Lanes<S>) -> Self::Lanes<S>;
}

/// What differs between the two kinds only in the names of the library's functions.
macro_rules! real {
    ($real:ident, $lanes:ident, $count:ident, $as_simd:ident, $as_mut_simd:ident, $partial_store:ident, $add:ident, $sub:ident,
     $mul:ident, $max:ident, $sum:ident) => {
        const ONE: Self = 1.0;

        #[inline(always)]
        fn count(n: usize) -> Self {
            n as Self
        }

        #[inline(always)]
        fn from_u8(value: u8) -> Self {
            Self::from(value)
        }

        #[inline(always)]
        fn from_f64(value: f64) -> Self {
            value as Self
        }

        #[inline(always)]
        fn tanh(self) -> Self {
            self.tanh()
        }

        #[inline(always)]
        fn sqrt(self) -> Self {
            self.sqrt()
        }

        #[inline(always)]
        fn sigmoid(self) -> Self {
            1.0 / (1.0 + (-self).exp())
        }

        #[inline(always)]
        fn store<S: Simd>(simd: S, slice: &mut [Self], lanes: S::$lanes) {
            match slice.get_mut(..S::$count).map(S::$as_mut_simd) {
                Some(([first], _)) => *first = lanes,
                _ => simd.$partial_store(slice, lanes),
            }
        }

        #[inline(always)]
        fn registers<S: Simd>(_: S, slice: &[Self]) -> &[S::$lanes] {
            S::$as_simd(slice).0
        }

        #[inline(always)]
        fn registers_mut<S: Simd>(_: S, slice: &mut [Self]) -> &mut [S::$lanes] {
            S::$as_mut_simd(slice).0
        }

        #[inline(always)]
        fn add_lanes<S: Simd>(simd: S, a: S::$lanes, b: S::$lanes) -> S::$lanes {
            simd.$add(a, b)
        }

        #[inline(always)]
        fn sub_lanes<S: Simd>(simd: S, a: S::$lanes, b: S::$lanes) -> S::$lanes {
            simd.$sub(a, b)
        }

        #[inline(always)]
        fn mul_lanes<S: Simd>(simd: S, a: S::$lanes, b: S::$lanes) -> S::$lanes {
            simd.$mul(a, b)
        }

        #[inline(always)]
        fn max_lanes<S: Simd>(simd: S, a: S::$lanes, b: S::$lanes) -> S::$lanes {
            simd.$max(a, b)
        }

        #[inline(always)]
        fn sum_lanes<S: Simd>(simd: S, lanes: S::$lanes) -> Self {
            simd.$sum(lanes)
        }
    };
}

/// A number as it is.
macro_rules! factor {
    ($real:ident, $lanes:ident, $count:ident, $splat:ident, $as_simd:ident, $partial_load:ident, $mul_add:ident) => {
        impl Factor for $real {
            type Sum = Self;
            type Lanes<S: Simd> = S::$lanes;
            const NUMBERS: usize = 1;
            const ZERO: Self = 0.0;

            #[inline(always)]
            fn splat<S: Simd>(simd: S, value: Self) -> S::$lanes {
                simd.$splat(value)
            }

            #[inline(always)]
            fn load<S: Simd>(simd: S, slice: &[Self]) -> S::$lanes {
                match slice.get(..S::$count).map(S::$as_simd) {
                    Some((&[lanes], _)) => lanes,
                    _ => simd.$partial_load(slice),
                }
            }

            #[inline(always)]
            fn mul_add<S: Simd>(simd: S, a: S::$lanes, b: S::$lanes, c: S::$lanes) -> S::$lanes {
                simd.$mul_add(a, b, c)
            }

            fn along<'a>(numbers: &'a [Self], _: &'a mut Aligned<Self>) -> &'a [Self] {
                numbers
            }

            fn across<'a>(numbers: &'a [Self], _: usize, _: &'a mut Aligned<Self>) -> &'a [Self] {
                numbers
            }
        }
    };
}

factor!(f64, f64s, F64_LANES, splat_f64s, as_simd_f64s, partial_load_f64s, mul_add_f64s);
factor!(f32, f32s, F32_LANES, splat_f32s, as_simd_f32s, partial_load_f32s, mul_add_f32s);

impl Real for f64 {
    /// It is there to check by.
    type Half = Self;
    real!(
        f64,
        f64s,
        F64_LANES,
        as_simd_f64s,
        as_mut_simd_f64s,
        partial_store_f64s,
        add_f64s,
        sub_f64s,
        mul_f64s,
        max_f64s,
        reduce_sum_f64s
    );

    #[inline(always)]
    fn sigmoids<S: Simd>(simd: S, lanes: S::f64s) -> S::f64s {
        // The widest registers hold eight; this is only for checks.
        let mut values = [0.0; 8];
        simd.partial_store_f64s(&mut values[..S::F64_LANES], lanes);
        simd.partial_load_f64s(&values.map(Real::sigmoid)[..S::F64_LANES])
    }
}

impl Real for f32 {
    type Half = Pair;
    real!(
        f32,
        f32s,
        F32_LANES,
        as_simd_f32s,
        as_mut_simd_f32s,
        partial_store_f32s,
        add_f32s,
        sub_f32s,
        mul_f32s,
        max_f32s,
        reduce_sum_f32s
    );

    /// To about two units in the last place: e^-x is 2^n times a polynomial of the rest, which lies within half a power of two
    /// (minimax in the relative error, by Lawson's iteration).
    #[inline(always)]
    fn sigmoids<S: Simd>(simd: S, lanes: S::f32s) -> S::f32s {
        let splat = |value: f32| simd.splat_f32s(value);
        // Beyond, float32 has neither room nor digits; the sigmoid is 0 or 1 long before. Not a number stays so.
        let x = simd.min_f32s(splat(88.0), simd.max_f32s(splat(-88.0), lanes));
        // Adding this rounds to a whole number, which then stands in the low bits, as an exponent does: 127 above.
        const ROUND: f32 = 12_582_912.0 + 127.0;
        let log2_e = splat(-std::f32::consts::LOG2_E);
        let shifted = simd.mul_add_f32s(x, log2_e, splat(ROUND));
        let rest = simd.mul_add_f32s(x, log2_e, simd.sub_f32s(splat(ROUND), shifted));
        // 2 to the rest, within 1.1e-7: a minimax polynomial.
        let mut power = splat(1.330_06e-3);
        for coefficient in [9.669_69e-3, 5.550_558e-2, 2.402_228_2e-1, std::f32::consts::LN_2, 1.0] {
            power = simd.mul_add_f32s(power, rest, splat(coefficient));
        }
        // The higher bits go over the edge.
        let exponent = simd.wrapping_dyn_shl_u32s(simd.transmute_u32s_f32s(shifted), simd.splat_u32s(23));
        let scale = simd.transmute_f32s_u32s(exponent);
        simd.div_f32s(splat(1.0), simd.mul_add_f32s(power, scale, splat(1.0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::{Arch, WithSimd};

    struct Sigmoids<'a, T>(&'a mut [T]);

    impl<T: Real> WithSimd for Sigmoids<'_, T> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            let lanes = size_of::<T::Lanes<S>>() / size_of::<T>();
            for chunk in self.0.chunks_mut(lanes) {
                let values = T::load(simd, chunk);
                T::store(simd, chunk, T::sigmoids(simd, values));
            }
        }
    }

    #[test]
    fn sigmoids_are_exact_enough() {
        let inputs: Vec<f32> = (-87_000..88_001).map(|i| i as f32 * 1e-3).collect();
        let mut ours = inputs.clone();
        Arch::new().dispatch(Sigmoids(&mut ours));
        let mut exact: Vec<f64> = inputs.iter().copied().map(f64::from).collect();
        Arch::new().dispatch(Sigmoids(&mut exact));
        for ((x, ours), exact) in inputs.iter().zip(ours).zip(exact) {
            // The last place of x moves its sigmoid by more than the second.
            let tolerance = 3e-7 + 1.5e-8 * f64::from(x.abs());
            assert!((f64::from(ours) - exact).abs() < tolerance * exact, "sigmoid({x}): {ours} for {exact}");
            assert!((1.0 / (1.0 + (-f64::from(*x)).exp()) - exact).abs() <= 1e-15 * exact, "sigmoid({x})");
        }
        let mut extremes = [f32::INFINITY, 1e30, 200.0, f32::NEG_INFINITY, -1e30];
        Arch::new().dispatch(Sigmoids(&mut extremes));
        assert_eq!(extremes[..3], [1.0; 3]);
        assert!(extremes[3..].iter().all(|value| (0.0..1e-37).contains(value)), "{extremes:?}");
        let mut unknown = [f32::NAN; 3];
        Arch::new().dispatch(Sigmoids(&mut unknown));
        assert!(unknown.iter().all(|value| value.is_nan()), "{unknown:?}");
    }
}
