//! float32 and float64 as [`Operand`] and [`Element`].

use super::bf16::Bf16x2;
use super::buffer::AlignedVec;
use super::element::{Element, Operand};
use pulp::Simd;

/// Methods of [`Element`] in terms of pulp's functions for a type.
macro_rules! element {
    ($float:ident, $register:ident, $count:ident, $as_simd:ident, $as_mut_simd:ident, $partial_store:ident, $add:ident, $sub:ident,
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
        fn store<S: Simd>(simd: S, slice: &mut [Self], register: S::$register) {
            match slice.get_mut(..S::$count).map(S::$as_mut_simd) {
                Some(([first], _)) => *first = register,
                _ => simd.$partial_store(slice, register),
            }
        }

        #[inline(always)]
        fn registers<S: Simd>(_: S, slice: &[Self]) -> &[S::$register] {
            S::$as_simd(slice).0
        }

        #[inline(always)]
        fn registers_mut<S: Simd>(_: S, slice: &mut [Self]) -> &mut [S::$register] {
            S::$as_mut_simd(slice).0
        }

        #[inline(always)]
        fn add_registers<S: Simd>(simd: S, a: S::$register, b: S::$register) -> S::$register {
            simd.$add(a, b)
        }

        #[inline(always)]
        fn sub_registers<S: Simd>(simd: S, a: S::$register, b: S::$register) -> S::$register {
            simd.$sub(a, b)
        }

        #[inline(always)]
        fn mul_registers<S: Simd>(simd: S, a: S::$register, b: S::$register) -> S::$register {
            simd.$mul(a, b)
        }

        #[inline(always)]
        fn max_registers<S: Simd>(simd: S, a: S::$register, b: S::$register) -> S::$register {
            simd.$max(a, b)
        }

        #[inline(always)]
        fn sum_register<S: Simd>(simd: S, register: S::$register) -> Self {
            simd.$sum(register)
        }
    };
}

/// A number as its own operand; packing is the identity.
macro_rules! operand {
    ($float:ident, $register:ident, $count:ident, $splat:ident, $as_simd:ident, $partial_load:ident, $mul_add:ident) => {
        impl Operand for $float {
            type Sum = Self;
            type Register<S: Simd> = S::$register;
            const PACK: usize = 1;
            const ZERO: Self = 0.0;

            #[inline(always)]
            fn splat<S: Simd>(simd: S, value: Self) -> S::$register {
                simd.$splat(value)
            }

            #[inline(always)]
            fn load<S: Simd>(simd: S, slice: &[Self]) -> S::$register {
                match slice.get(..S::$count).map(S::$as_simd) {
                    Some((&[register], _)) => register,
                    _ => simd.$partial_load(slice),
                }
            }

            #[inline(always)]
            fn mul_add<S: Simd>(simd: S, a: S::$register, b: S::$register, c: S::$register) -> S::$register {
                simd.$mul_add(a, b, c)
            }

            fn pack_along_k<'a>(numbers: &'a [Self], _: &'a mut AlignedVec<Self>) -> &'a [Self] {
                numbers
            }

            fn pack_row_pairs<'a>(numbers: &'a [Self], _: usize, _: &'a mut AlignedVec<Self>) -> &'a [Self] {
                numbers
            }
        }
    };
}

operand!(f64, f64s, F64_LANES, splat_f64s, as_simd_f64s, partial_load_f64s, mul_add_f64s);
operand!(f32, f32s, F32_LANES, splat_f32s, as_simd_f32s, partial_load_f32s, mul_add_f32s);

impl Element for f64 {
    /// Float64 itself: the type serves gradient checks only.
    type Half = Self;
    element!(
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
    fn sigmoid_register<S: Simd>(simd: S, register: S::f64s) -> S::f64s {
        // The widest registers hold eight; speed is irrelevant in gradient checks.
        let mut values = [0.0; 8];
        simd.partial_store_f64s(&mut values[..S::F64_LANES], register);
        simd.partial_load_f64s(&values.map(Element::sigmoid)[..S::F64_LANES])
    }
}

impl Element for f32 {
    type Half = Bf16x2;
    element!(
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

    /// The sigmoid, to about two units in the last place: e^-x = 2^n p(r), with n = round(-x log2 e), |r| ≤ 1/2, and a polynomial
    /// p that is minimax in the relative error (by Lawson's iteration).
    #[inline(always)]
    fn sigmoid_register<S: Simd>(simd: S, register: S::f32s) -> S::f32s {
        let splat = |value: f32| simd.splat_f32s(value);

        // Range reduction. Beyond ±88 e^-x leaves the range of float32, and the sigmoid has long rounded to 0 or 1. NaN stays NaN.
        let x = simd.min_f32s(splat(88.0), simd.max_f32s(splat(-88.0), register));
        // Adding ROUND rounds to an integer, in the low bits of the sum, with the exponent's bias of 127.
        const ROUND: f32 = 12_582_912.0 + 127.0;
        let log2_e = splat(-std::f32::consts::LOG2_E);
        let shifted = simd.mul_add_f32s(x, log2_e, splat(ROUND));
        let rest = simd.mul_add_f32s(x, log2_e, simd.sub_f32s(splat(ROUND), shifted));

        // 2^r, with a relative error of at most 1.1e-7.
        let mut power = splat(1.330_06e-3);
        for coefficient in [9.669_69e-3, 5.550_558e-2, 2.402_228_2e-1, std::f32::consts::LN_2, 1.0] {
            power = simd.mul_add_f32s(power, rest, splat(coefficient));
        }

        // 2^n: the shift moves the biased integer into the exponent and drops the higher bits.
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

    impl<T: Element> WithSimd for Sigmoids<'_, T> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            let lanes = size_of::<T::Register<S>>() / size_of::<T>();
            for chunk in self.0.chunks_mut(lanes) {
                let values = T::load(simd, chunk);
                T::store(simd, chunk, T::sigmoid_register(simd, values));
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
            // The second term is the rounding error of log2 e; the last place of x changes the sigmoid by more.
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
