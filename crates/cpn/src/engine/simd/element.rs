//! Element types: [`Operand`], the factor of a matrix product, and [`Element`], a floating-point number: float32, and float64 for
//! gradient checks.

use super::buffer::AlignedVec;
use pulp::{Arch, Simd, WithSimd};
use std::fmt::Debug;
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

/// Operand of matrix products: one number, or a [pair of bfloat16](super::bf16), with its register type. An operand of PACK numbers
/// divides a product's inner dimension by PACK.
pub trait Operand: Copy + Debug + Default + PartialEq + Send + Sync + 'static {
    /// Type of the accumulated products.
    type Sum: Element;
    /// A register of operands, as many as a register of sums has sums.
    type Register<S: Simd>: Copy + Debug;
    /// Number of numbers in an operand.
    const PACK: usize;
    /// An operand of zeros; equal to its `Default`, which fills new buffers.
    const ZERO: Self;

    /// A register with all lanes equal to `value`.
    fn splat<S: Simd>(simd: S, value: Self) -> Self::Register<S>;
    /// Loads the first operands of a slice, with zeros past its end.
    fn load<S: Simd>(simd: S, slice: &[Self]) -> Self::Register<S>;
    /// a b + c; for packed operands the sum of all PACK products.
    fn mul_add<S: Simd>(
        simd: S,
        a: Self::Register<S>,
        b: Self::Register<S>,
        c: <Self::Sum as Operand>::Register<S>,
    ) -> <Self::Sum as Operand>::Register<S>;

    /// Runs a kernel with the processor's widest registers for this operand.
    #[inline(always)]
    fn dispatch<W: WithSimd>(kernel: W) -> W::Output {
        Arch::new().dispatch(kernel)
    }

    /// Packing along rows: `[R, N]` as `[R, N / PACK]`, in `workspace` if a conversion is needed.
    fn pack_along_k<'a>(numbers: &'a [Self::Sum], workspace: &'a mut AlignedVec<Self>) -> &'a [Self];
    /// Packing across rows: `[R, columns]` as `[R / PACK, columns]`, with zeros below an odd last row.
    fn pack_row_pairs<'a>(numbers: &'a [Self::Sum], columns: usize, workspace: &'a mut AlignedVec<Self>) -> &'a [Self];
}

/// A floating-point number with its register type.
pub trait Element:
    Operand<Sum = Self>
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
    /// Operand of lower precision for products.
    type Half: Operand<Sum = Self>;
    /// 1.
    const ONE: Self;

    /// Conversion of a count.
    fn count(n: usize) -> Self;
    /// Conversion of a byte.
    fn from_u8(value: u8) -> Self;
    /// Conversion to the nearest number.
    fn from_f64(value: f64) -> Self;
    /// The hyperbolic tangent.
    fn tanh(self) -> Self;
    /// The square root.
    fn sqrt(self) -> Self;
    /// The logistic sigmoid, 1 / (1 + e^-x).
    fn sigmoid(self) -> Self;

    /// Stores a register at the beginning of a slice, truncated to the slice's length.
    fn store<S: Simd>(simd: S, slice: &mut [Self], register: Self::Register<S>);
    /// The slice as registers, without the remainder.
    fn registers<S: Simd>(simd: S, slice: &[Self]) -> &[Self::Register<S>];
    /// Mutable [`Self::registers`].
    fn registers_mut<S: Simd>(simd: S, slice: &mut [Self]) -> &mut [Self::Register<S>];
    /// a + b.
    fn add_registers<S: Simd>(simd: S, a: Self::Register<S>, b: Self::Register<S>) -> Self::Register<S>;
    /// a - b.
    fn sub_registers<S: Simd>(simd: S, a: Self::Register<S>, b: Self::Register<S>) -> Self::Register<S>;
    /// a b.
    fn mul_registers<S: Simd>(simd: S, a: Self::Register<S>, b: Self::Register<S>) -> Self::Register<S>;
    /// The maximum of a and b; b if either is NaN.
    fn max_registers<S: Simd>(simd: S, a: Self::Register<S>, b: Self::Register<S>) -> Self::Register<S>;
    /// The horizontal sum of a register.
    fn sum_register<S: Simd>(simd: S, register: Self::Register<S>) -> Self;
    /// The sigmoid of each number of a register.
    fn sigmoid_register<S: Simd>(simd: S, register: Self::Register<S>) -> Self::Register<S>;
}
