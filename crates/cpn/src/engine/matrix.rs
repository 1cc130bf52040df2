//! Matrices as [products](super::product) read them.

use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Operand;
use crate::engine::simd::vector::VectorShape;

/// Registers side by side in a panel.
pub const REGISTERS: usize = 2;
/// Where three leave less of the last panel empty, and there are enough.
pub const MORE_REGISTERS: usize = 3;

/// b of a product, `[inner, columns]`, in panels of as many columns as fill some registers.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a, E> {
    pub values: &'a [E],
    pub inner: usize,
    pub columns: usize,
    /// From a row of a panel to the next.
    pub stride: usize,
    /// Registers of a panel.
    pub side_by_side: usize,
    /// Whether it is laid out panel by panel, and not row by row.
    pub in_panels: bool,
    /// Rows whose panels all go on to their ends, into the next row or not; past b's end there may be nothing to fill the
    /// registers with.
    pub whole: usize,
}

impl<'a, E: Operand> Matrix<'a, E> {
    /// `[inner, columns]`, row by row.
    pub fn new(values: &'a [E], columns: usize) -> Self {
        let (inner, shape) = (values.len() / columns, VectorShape::of::<E>());
        let end = |side_by_side| columns.next_multiple_of(side_by_side * shape.lanes);
        let more = shape.registers >= 32 && end(MORE_REGISTERS) < end(REGISTERS);
        let side_by_side = if more { MORE_REGISTERS } else { REGISTERS };
        // A row by itself takes panels of the fewer registers all the same, which end behind the others.
        let beyond = (end(REGISTERS) - columns).div_ceil(columns);
        let whole = if columns < side_by_side * shape.lanes { 0 } else { inner.saturating_sub(beyond) };
        Self { values, inner, columns, stride: columns, side_by_side, in_panels: false, whole }
    }

    /// A panel of so many numbers a row, and all that follows it.
    #[inline(always)]
    pub fn panel(&self, panel: usize, width: usize) -> &'a [E] {
        &self.values[panel * if self.in_panels { self.inner * self.stride } else { width }..]
    }
}

/// A matrix laid out panel by panel, so that products read it from one end to the other; the last panel is filled up with
/// zeros.
#[derive(Debug)]
pub struct Panels<E> {
    values: AlignedVec<E>,
    inner: usize,
    columns: usize,
}

impl<E: Operand> Panels<E> {
    /// Lays out the transpose of `[columns, inner]`.
    pub fn transposed(values: &[E], inner: usize) -> Self {
        let (columns, width) = (values.len() / inner, Self::width());
        let mut panels = zeros(inner * columns.next_multiple_of(width));
        for (panel, rows) in panels.chunks_exact_mut(inner * width).zip(values.chunks(inner * width)) {
            // Written from one end to the other; what is read lies in no more lines than a panel has columns.
            let rows: Vec<_> = rows.chunks_exact(inner).collect();
            for (k, line) in panel.chunks_exact_mut(width).enumerate() {
                for (value, row) in line.iter_mut().zip(&rows) {
                    *value = row[k];
                }
            }
        }
        Self { values: panels, inner, columns }
    }

    /// Columns of a panel.
    fn width() -> usize {
        REGISTERS * VectorShape::of::<E>().lanes
    }

    /// All of it, for a product.
    pub fn matrix(&self) -> Matrix<'_, E> {
        let &Self { ref values, inner, columns } = self;
        let (stride, side_by_side) = (Self::width(), REGISTERS);
        Matrix { values, inner, columns, stride, side_by_side, in_panels: true, whole: inner }
    }
}
