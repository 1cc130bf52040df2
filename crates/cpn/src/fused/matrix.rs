//! Matrices as [products](super::product) read them.

use super::lanes::{Aligned, Lanes, zeros};
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};
use std::marker::PhantomData;
use std::ops::Range;

/// Registers side by side in a panel.
pub const REGISTERS: usize = 2;

/// b of a product, `[inner, columns]`, in panels of as many columns as fill some registers.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a, T> {
    pub values: &'a [T],
    pub inner: usize,
    pub columns: usize,
    /// From a row of a panel to the next.
    pub stride: usize,
    /// From a panel to the next.
    pub apart: usize,
    /// Rows whose panels all go on to their ends, into the next row or not; past b's end there may be nothing to fill the
    /// registers with.
    pub whole: usize,
}

impl<'a, T: Real> Matrix<'a, T> {
    /// `[inner, columns]`, row by row.
    pub fn new(values: &'a [T], columns: usize) -> Self {
        let (inner, width) = (values.len() / columns, Shape::of::<T>().width);
        let beyond = columns.next_multiple_of(width) - columns;
        let whole = if columns < width { 0 } else { inner.saturating_sub(beyond.div_ceil(columns)) };
        Self { values, inner, columns, stride: columns, apart: width, whole }
    }
}

/// A matrix laid out panel by panel, so that products read it from one end to the other; the last panel is filled up with
/// zeros.
#[derive(Debug)]
pub struct Panels<T> {
    values: Aligned<T>,
    inner: usize,
    columns: usize,
}

impl<T: Real> Panels<T> {
    /// Lays out the transpose of `[columns, inner]`.
    pub fn transposed(values: &[T], inner: usize) -> Self {
        let (columns, width) = (values.len() / inner, Shape::of::<T>().width);
        let mut panels = zeros(inner * columns.next_multiple_of(width));
        for (panel, rows) in panels.chunks_exact_mut(inner * width).zip(values.chunks(inner * width)) {
            for (j, row) in rows.chunks_exact(inner).enumerate() {
                for (k, value) in row.iter().enumerate() {
                    panel[k * width + j] = *value;
                }
            }
        }
        Self { values: panels, inner, columns }
    }

    /// Columns of a panel.
    pub fn width(&self) -> usize {
        Shape::of::<T>().width
    }

    /// Some columns, from a panel's first on, for a product.
    pub fn matrix(&self, columns: Range<usize>) -> Matrix<'_, T> {
        let (inner, stride) = (self.inner, self.width());
        assert!(columns.start.is_multiple_of(stride) && columns.end <= self.columns, "columns of some panels");
        let values = &self.values[columns.start * inner..];
        Matrix { values, inner, columns: columns.len(), stride, apart: inner * stride, whole: inner }
    }
}

/// What suits this processor.
#[derive(Debug, Clone, Copy)]
pub struct Shape {
    /// Of a panel.
    pub width: usize,
    /// Registers.
    pub registers: usize,
}

impl Shape {
    pub fn of<T: Real>() -> Self {
        struct Ask<T>(PhantomData<T>);
        impl<T: Real> WithSimd for Ask<T> {
            type Output = Shape;

            #[inline(always)]
            fn with_simd<S: Simd>(self, _simd: S) -> Shape {
                Shape { width: REGISTERS * Lanes::<S, T>::COUNT, registers: S::REGISTER_COUNT }
            }
        }
        Arch::new().dispatch(Ask::<T>(PhantomData))
    }
}
