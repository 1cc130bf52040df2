//! What [products](super::product) multiply: numbers as they are, or [pairs](super::pair) in bfloat16.

use super::lanes::Aligned;
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};
use std::fmt::Debug;

/// One or two numbers, and registers full of them. Where there are two, a product's inner dimension is half as long.
pub trait Factor: Copy + Debug + Default + PartialEq + Send + Sync + 'static {
    /// What products are added up in.
    type Sum: Real;
    /// A register, with as many factors as one of sums has sums.
    type Lanes<S: Simd>: Copy + Debug;
    /// Numbers in one.
    const NUMBERS: usize;
    /// Of zeros.
    const ZERO: Self;

    /// The same everywhere.
    fn splat<S: Simd>(simd: S, value: Self) -> Self::Lanes<S>;
    /// The first of a slice; zeros where it ends.
    fn load<S: Simd>(simd: S, slice: &[Self]) -> Self::Lanes<S>;
    /// a b + c, of pairs both products.
    fn mul_add<S: Simd>(
        simd: S,
        a: Self::Lanes<S>,
        b: Self::Lanes<S>,
        c: <Self::Sum as Factor>::Lanes<S>,
    ) -> <Self::Sum as Factor>::Lanes<S>;

    /// Runs a kernel by the widest registers that there are for it.
    #[inline(always)]
    fn dispatch<W: WithSimd>(kernel: W) -> W::Output {
        Arch::new().dispatch(kernel)
    }

    /// Numbers that follow each other as factors, `[R, N]` to `[R, N / NUMBERS]`; there may be `room` for them.
    fn along<'a>(numbers: &'a [Self::Sum], room: &'a mut Aligned<Self>) -> &'a [Self];
    /// Numbers of rows that follow each other, `[R, columns]`, as factors `[R / NUMBERS, columns]`, with zeros below an odd row.
    fn across<'a>(numbers: &'a [Self::Sum], columns: usize, room: &'a mut Aligned<Self>) -> &'a [Self];
}
