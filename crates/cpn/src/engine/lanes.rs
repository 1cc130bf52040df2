//! Numbers side by side in a register of the processor, as wide as it has them.

use super::factor::Factor;
use super::real::Real;
use aligned_vec::{AVec, avec};
use pulp::Simd;
use std::ops::{Add, Mul, Sub};

/// Numbers that begin at the start of a cache line, so that registers are not filled from two.
pub type Aligned<T> = AVec<T>;

/// So many zeros.
pub fn zeros<E: Factor>(count: usize) -> Aligned<E> {
    avec![E::ZERO; count]
}

/// So much of a memory, which grows if it must.
pub fn grown<E: Factor>(memory: &mut Aligned<E>, size: usize) -> &mut [E] {
    if memory.len() < size {
        memory.resize(size, E::ZERO);
    }
    &mut memory[..size]
}

/// The first `count` registers of each slice.
#[inline(always)]
pub fn registers<S: Simd, T: Real, const N: usize>(simd: S, slices: [&[T]; N], count: usize) -> [&[T::Lanes<S>]; N] {
    slices.map(|slice| &T::registers(simd, slice)[..count])
}

/// The same, to be written.
#[inline(always)]
pub fn registers_mut<S: Simd, T: Real, const N: usize>(
    simd: S,
    slices: [&mut [T]; N],
    count: usize,
) -> [&mut [T::Lanes<S>]; N] {
    slices.map(|slice| &mut T::registers_mut(simd, slice)[..count])
}

/// As many numbers as fill a register.
#[derive(Debug)]
pub struct Lanes<S: Simd, T: Real> {
    simd: S,
    values: T::Lanes<S>,
}

impl<S: Simd, T: Real> Clone for Lanes<S, T> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd, T: Real> Copy for Lanes<S, T> {}

impl<S: Simd, T: Real> Lanes<S, T> {
    /// How many.
    pub const COUNT: usize = size_of::<T::Lanes<S>>() / size_of::<T>();

    /// The same number everywhere.
    #[inline(always)]
    pub fn splat(simd: S, value: T) -> Self {
        Self { simd, values: T::splat(simd, value) }
    }

    /// The first numbers of a slice; zeros where it ends.
    #[inline(always)]
    pub fn load(simd: S, slice: &[T]) -> Self {
        Self { simd, values: T::load(simd, slice) }
    }

    /// Of several registers.
    #[inline(always)]
    pub fn each<const N: usize>(simd: S, registers: [T::Lanes<S>; N]) -> [Self; N] {
        let mut lanes = [Self::splat(simd, T::ZERO); N];
        for (lanes, values) in lanes.iter_mut().zip(registers) {
            lanes.values = values;
        }
        lanes
    }

    /// The register.
    #[inline(always)]
    pub fn values(self) -> T::Lanes<S> {
        self.values
    }

    /// Of several slices the first numbers each.
    #[inline(always)]
    pub fn load_each<const N: usize>(simd: S, slices: [&[T]; N]) -> [Self; N] {
        // A loop, for the closure of a `map` is not always made part of the kernel.
        let mut lanes = [Self::splat(simd, T::ZERO); N];
        for (lanes, slice) in lanes.iter_mut().zip(slices) {
            *lanes = Self::load(simd, slice);
        }
        lanes
    }

    /// Writes over the first numbers of a slice, as many as it has.
    #[inline(always)]
    pub fn store(self, slice: &mut [T]) {
        T::store(self.simd, slice, self.values);
    }

    /// Adds to the first numbers of a slice.
    #[inline(always)]
    pub fn add_to(self, slice: &mut [T]) {
        (Self::load(self.simd, slice) + self).store(slice);
    }

    /// `self * factor + summand`, rounded once.
    #[inline(always)]
    pub fn mul_add(self, factor: Self, summand: Self) -> Self {
        Self { values: T::mul_add(self.simd, self.values, factor.values, summand.values), ..self }
    }

    /// With products of factors added.
    #[inline(always)]
    pub fn add_product<E: Factor<Sum = T>>(self, a: E::Lanes<S>, b: E::Lanes<S>) -> Self {
        Self { values: E::mul_add(self.simd, a, b, self.values), ..self }
    }

    /// relu of each. What is not a number stays so, for somebody to see.
    #[inline(always)]
    pub fn rectified(self) -> Self {
        Self { values: T::max_lanes(self.simd, T::splat(self.simd, T::ZERO), self.values), ..self }
    }

    /// σ of each.
    #[inline(always)]
    pub fn sigmoid(self) -> Self {
        Self { values: T::sigmoids(self.simd, self.values), ..self }
    }

    /// The sum.
    #[inline(always)]
    pub fn sum(self) -> T {
        T::sum_lanes(self.simd, self.values)
    }
}

impl<S: Simd, T: Real> Add for Lanes<S, T> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { values: T::add_lanes(self.simd, self.values, other.values), ..self }
    }
}

impl<S: Simd, T: Real> Sub for Lanes<S, T> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { values: T::sub_lanes(self.simd, self.values, other.values), ..self }
    }
}

impl<S: Simd, T: Real> Mul for Lanes<S, T> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self { values: T::mul_lanes(self.simd, self.values, other.values), ..self }
    }
}
