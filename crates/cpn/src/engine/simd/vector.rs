//! Vectors: registers with arithmetic, of the processor's width.

use super::element::{Element, Operand};
use pulp::{Arch, Simd, WithSimd};
use std::marker::PhantomData;
use std::ops::{Add, Mul, Sub};

/// The first `count` registers of each slice.
#[inline(always)]
pub fn registers<S: Simd, T: Element, const N: usize>(
    simd: S,
    slices: [&[T]; N],
    count: usize,
) -> [&[T::Register<S>]; N] {
    slices.map(|slice| &T::registers(simd, slice)[..count])
}

/// Mutable [`registers`].
#[inline(always)]
pub fn registers_mut<S: Simd, T: Element, const N: usize>(
    simd: S,
    slices: [&mut [T]; N],
    count: usize,
) -> [&mut [T::Register<S>]; N] {
    slices.map(|slice| &mut T::registers_mut(simd, slice)[..count])
}

/// Elementwise `sum += x`.
pub fn add<T: Element>(sum: &mut [T], x: &[T]) {
    Arch::new().dispatch(AddAssign { sum, x });
}

#[derive(Debug)]
struct AddAssign<'a, T> {
    sum: &'a mut [T],
    x: &'a [T],
}

impl<T: Element> WithSimd for AddAssign<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let count = Vector::<S, T>::COUNT;
        for (sum, x) in self.sum.chunks_mut(count).zip(self.x.chunks(count)) {
            Vector::load(simd, x).add_to(sum);
        }
    }
}

/// Shape of the processor's registers for an operand type.
#[derive(Debug, Clone, Copy)]
pub struct VectorShape {
    /// Number of operands, or sums, in a register.
    pub lanes: usize,
    /// Number of registers.
    pub registers: usize,
}

impl VectorShape {
    /// The shape chosen by [`Operand::dispatch`].
    pub fn of<E: Operand>() -> Self {
        struct Shape<E>(PhantomData<E>);
        impl<E: Operand> WithSimd for Shape<E> {
            type Output = VectorShape;

            #[inline(always)]
            fn with_simd<S: Simd>(self, _simd: S) -> VectorShape {
                VectorShape { lanes: size_of::<E::Register<S>>() / size_of::<E>(), registers: S::REGISTER_COUNT }
            }
        }
        E::dispatch(Shape::<E>(PhantomData))
    }
}

/// A register of numbers, with arithmetic.
#[derive(Debug)]
pub struct Vector<S: Simd, T: Element> {
    simd: S,
    register: T::Register<S>,
}

impl<S: Simd, T: Element> Clone for Vector<S, T> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd, T: Element> Copy for Vector<S, T> {}

impl<S: Simd, T: Element> Vector<S, T> {
    /// Number of numbers in a vector.
    pub const COUNT: usize = size_of::<T::Register<S>>() / size_of::<T>();

    /// A vector with all lanes equal to `value`.
    #[inline(always)]
    pub fn splat(simd: S, value: T) -> Self {
        Self { simd, register: T::splat(simd, value) }
    }

    /// Loads the first numbers of a slice, with zeros past its end.
    #[inline(always)]
    pub fn load(simd: S, slice: &[T]) -> Self {
        Self { simd, register: T::load(simd, slice) }
    }

    /// Registers as vectors.
    #[inline(always)]
    pub fn from_registers<const N: usize>(simd: S, registers: [T::Register<S>; N]) -> [Self; N] {
        let mut vectors = [Self::splat(simd, T::ZERO); N];
        for (vector, register) in vectors.iter_mut().zip(registers) {
            vector.register = register;
        }
        vectors
    }

    /// The underlying register.
    #[inline(always)]
    pub fn register(self) -> T::Register<S> {
        self.register
    }

    /// [`Self::load`] of each slice.
    #[inline(always)]
    pub fn load_each<const N: usize>(simd: S, slices: [&[T]; N]) -> [Self; N] {
        // A loop, since the closure of a `map` is not always inlined into the kernel.
        let mut vectors = [Self::splat(simd, T::ZERO); N];
        for (vector, slice) in vectors.iter_mut().zip(slices) {
            *vector = Self::load(simd, slice);
        }
        vectors
    }

    /// Stores at the beginning of a slice, truncated to the slice's length.
    #[inline(always)]
    pub fn store(self, slice: &mut [T]) {
        T::store(self.simd, slice, self.register);
    }

    /// Adds to the beginning of a slice, truncated to the slice's length.
    #[inline(always)]
    pub fn add_to(self, slice: &mut [T]) {
        (Self::load(self.simd, slice) + self).store(slice);
    }

    /// Fused `self * factor + summand`.
    #[inline(always)]
    pub fn mul_add(self, factor: Self, summand: Self) -> Self {
        Self { register: T::mul_add(self.simd, self.register, factor.register, summand.register), ..self }
    }

    /// `self` + a b, for registers of operands.
    #[inline(always)]
    pub fn add_product<E: Operand<Sum = T>>(self, a: E::Register<S>, b: E::Register<S>) -> Self {
        Self { register: E::mul_add(self.simd, a, b, self.register), ..self }
    }

    /// The rectified linear unit of each number; NaN stays NaN, so that it is detected.
    #[inline(always)]
    pub fn relu(self) -> Self {
        Self { register: T::max_registers(self.simd, T::splat(self.simd, T::ZERO), self.register), ..self }
    }

    /// The sigmoid σ of each number.
    #[inline(always)]
    pub fn sigmoid(self) -> Self {
        Self { register: T::sigmoid_register(self.simd, self.register), ..self }
    }

    /// The horizontal sum.
    #[inline(always)]
    pub fn sum(self) -> T {
        T::sum_register(self.simd, self.register)
    }
}

impl<S: Simd, T: Element> Add for Vector<S, T> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { register: T::add_registers(self.simd, self.register, other.register), ..self }
    }
}

impl<S: Simd, T: Element> Sub for Vector<S, T> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { register: T::sub_registers(self.simd, self.register, other.register), ..self }
    }
}

impl<S: Simd, T: Element> Mul for Vector<S, T> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self { register: T::mul_registers(self.simd, self.register, other.register), ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_added_at_every_length() {
        for len in 0..70 {
            let mut sum: Vec<f64> = (0..len).map(f64::from).collect();
            let x: Vec<f64> = (0..len).map(|i| f64::from(i) * 0.5).collect();
            add(&mut sum, &x);
            assert!(sum.iter().enumerate().all(|(i, sum)| *sum == i as f64 * 1.5), "{len}: {sum:?}");
        }
    }

    struct Arithmetic<'a> {
        a: &'a [f32],
        b: &'a [f32],
        /// a b + a, relu(a - b), a + b.
        results: [&'a mut [f32]; 3],
    }

    impl WithSimd for Arithmetic<'_> {
        type Output = f32;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> f32 {
            let [a, b] = Vector::<S, f32>::load_each(simd, [self.a, self.b]);
            let [product, relu, sum] = self.results;
            a.mul_add(b, a).store(product);
            (a - b).relu().store(relu);
            (a + b).store(sum);
            a.sum()
        }
    }

    /// A register holds 1 to 16 numbers; a shorter slice is padded with zeros.
    #[test]
    fn arithmetic_is_by_element() {
        for len in 1..17 {
            let a: Vec<f32> = (0..len).map(|i| i as f32 - 2.0).collect();
            let b: Vec<f32> = (0..len).map(|i| 5.0 - 2.0 * i as f32).collect();
            let [mut product, mut relu, mut sum] = [(); 3].map(|()| vec![f32::NAN; len]);
            let results = [&mut product[..], &mut relu, &mut sum];
            let total = Arch::new().dispatch(Arithmetic { a: &a, b: &b, results });
            let count = VectorShape::of::<f32>().lanes.min(len);
            assert_eq!(total, a[..count].iter().sum::<f32>());
            for i in 0..count {
                assert_eq!(product[i], a[i] * b[i] + a[i]);
                assert_eq!(relu[i], (a[i] - b[i]).max(0.0));
                assert_eq!(sum[i], a[i] + b[i]);
            }
        }
    }

    #[test]
    fn relu_keeps_nan() {
        let [mut product, mut relu, mut sum] = [[0.0f32]; 3];
        let results = [&mut product[..], &mut relu, &mut sum];
        Arch::new().dispatch(Arithmetic { a: &[f32::NAN], b: &[1.0], results });
        assert!(relu[0].is_nan());
    }
}
