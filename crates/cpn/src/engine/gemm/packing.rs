//! Layouts of the right-hand side b of a [product](super::kernel): row-major, or packed in panels.

use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Operand;
use crate::engine::simd::vector::VectorShape;

/// Width of a panel (NR), in vectors.
pub const NR_VECTORS: usize = 2;
/// Width of wide panels, in vectors: for processors with enough registers, where they leave less of the last panel empty.
pub const WIDE_NR_VECTORS: usize = 3;

/// View of b, `[inner, columns]`, in panels of [`Self::nr_vectors`] vectors.
#[derive(Debug, Clone, Copy)]
pub struct BLayout<'a, E> {
    /// The values, row-major or panel by panel.
    pub values: &'a [E],
    /// Rows of b.
    pub inner: usize,
    /// Columns of b.
    pub columns: usize,
    /// Distance between the rows of a panel, in values.
    pub stride: usize,
    /// Width of a panel, in vectors.
    pub nr_vectors: usize,
    /// True for the packed layout, false for row-major.
    pub packed: bool,
    /// Number of leading rows whose panels may be loaded at full width, even into the next row; the others would overrun the end
    /// of b.
    pub full_rows: usize,
}

impl<'a, E: Operand> BLayout<'a, E> {
    /// Row-major layout of `[inner, columns]`.
    pub fn new(values: &'a [E], columns: usize) -> Self {
        let (inner, shape) = (values.len() / columns, VectorShape::of::<E>());

        // The panel width that leaves less of the last panel empty.
        let end = |nr_vectors| columns.next_multiple_of(nr_vectors * shape.lanes);
        let is_wide = shape.registers >= 32 && end(WIDE_NR_VECTORS) < end(NR_VECTORS);
        let nr_vectors = if is_wide { WIDE_NR_VECTORS } else { NR_VECTORS };

        // Single rows always use the narrow panels, whose last one may end further to the right.
        let overrun_rows = (end(NR_VECTORS) - columns).div_ceil(columns);
        let full_rows = if columns < nr_vectors * shape.lanes { 0 } else { inner.saturating_sub(overrun_rows) };
        Self { values, inner, columns, stride: columns, nr_vectors, packed: false, full_rows }
    }

    /// The values from the beginning of a panel of `width` columns on.
    #[inline(always)]
    pub fn panel(&self, panel: usize, width: usize) -> &'a [E] {
        &self.values[panel * if self.packed { self.inner * self.stride } else { width }..]
    }
}

/// b packed in panels, which products read sequentially; the last panel is padded with zeros.
#[derive(Debug)]
pub struct PackedB<E> {
    values: AlignedVec<E>,
    inner: usize,
    columns: usize,
}

impl<E: Operand> PackedB<E> {
    /// Packs the transpose of `values`, `[columns, inner]`.
    pub fn transposed(values: &[E], inner: usize) -> Self {
        let (columns, width) = (values.len() / inner, Self::width());
        let mut panels = zeros(inner * columns.next_multiple_of(width));
        for (panel, rows) in panels.chunks_exact_mut(inner * width).zip(values.chunks(inner * width)) {
            // Written sequentially, and read from as many cache lines as a panel has columns.
            let rows: Vec<_> = rows.chunks_exact(inner).collect();
            for (k, line) in panel.chunks_exact_mut(width).enumerate() {
                for (value, row) in line.iter_mut().zip(&rows) {
                    *value = row[k];
                }
            }
        }
        Self { values: panels, inner, columns }
    }

    /// Number of columns of a panel.
    fn width() -> usize {
        NR_VECTORS * VectorShape::of::<E>().lanes
    }

    /// The layout for a product.
    pub fn layout(&self) -> BLayout<'_, E> {
        let &Self { ref values, inner, columns } = self;
        let (stride, nr_vectors) = (Self::width(), NR_VECTORS);
        BLayout { values, inner, columns, stride, nr_vectors, packed: true, full_rows: inner }
    }
}
