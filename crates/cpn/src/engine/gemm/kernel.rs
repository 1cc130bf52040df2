//! The matrix product c = a b. Every element of c is summed along the inner dimension in order, so that a row of c is bit for bit
//! independent of the other rows.
//!
//! Arrays in registers are filled in loops of constant length over slices of constant length: with closures and iterators the
//! compiler spills them to memory.

use super::packing::{BLayout, NR_VECTORS, WIDE_NR_VECTORS};
use crate::engine::simd::element::{Element, Operand};
use crate::engine::simd::vector::Vector;
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// Size of the largest tile, eight rows of a panel, in elements.
const TILE: usize = 8 * WIDE_NR_VECTORS * 16;
/// Length of the chunks of a single row that are scanned for zeros.
const CHUNK: usize = 256;
/// Minimum size of b, in operands, for which scanning a row for zeros is worthwhile.
const SMALL: usize = 1 << 14;

/// The product c = a b, `[rows, columns]`; with `accumulate` c += a b.
pub fn gemm<E: Operand>(accumulate: bool, c: &mut [E::Sum], a: Lhs<'_, E>, b: BLayout<'_, E>) {
    let mut gemm = Gemm { accumulate, rows: c.len() / b.columns, c, a, b };
    gemm.run();
}

/// The operands and the result of a product.
#[derive(Debug)]
struct Gemm<'a, E: Operand> {
    accumulate: bool,
    rows: usize,
    c: &'a mut [E::Sum],
    a: Lhs<'a, E>,
    b: BLayout<'a, E>,
}

/// The left-hand side a of a product.
#[derive(Debug, Clone, Copy)]
pub enum Lhs<'a, E> {
    /// a, `[rows, inner]`.
    Rows(&'a [E]),
    /// aᵀ, `[inner, rows]`.
    Transposed(&'a [E]),
}

/// Sums of a tile in registers: R rows, P panels of W vectors.
type TileSums<S, T, const R: usize, const P: usize, const W: usize> = [[[Vector<S, T>; W]; P]; R];

/// An index k along the inner dimension, with the values of b from row k of each of P panels on.
type KIndex<'a, E, const P: usize> = (usize, [&'a [E]; P]);

impl<E: Operand> Gemm<'_, E> {
    fn run(&mut self) {
        let (rows, BLayout { inner, columns, .. }) = (self.rows, self.b);
        let (Lhs::Rows(a) | Lhs::Transposed(a)) = self.a;
        assert!(self.c.len() == rows * columns && a.len() == rows * inner, "shapes of a product");
        if self.b.nr_vectors == WIDE_NR_VECTORS {
            self.all_rows::<WIDE_NR_VECTORS>();
        } else {
            self.all_rows::<NR_VECTORS>();
        }
    }

    /// All rows, in panels of W vectors.
    fn all_rows<const W: usize>(&mut self) {
        let mut row = self.row_tiles::<8, W>(0);
        row = self.row_tiles::<6, W>(row);
        row = self.row_tiles::<4, W>(row);
        row = self.row_tiles::<2, W>(row);
        for row in row..self.rows {
            E::dispatch(SingleRow { gemm: self, row });
        }
    }

    /// Tiles of R rows from `row` on, while R rows are left and if the registers hold so many; returns the row after them.
    fn row_tiles<const R: usize, const W: usize>(&mut self, row: usize) -> usize {
        let end = row + (self.rows - row) / R * R;
        if end > row { E::dispatch(RowTiles::<E, R, W> { gemm: self, rows: row..end }) } else { row }
    }

    /// The contribution of indices along the inner dimension to a tile of c, R rows and P panels; `first` replaces c, else it is
    /// added. The indices come in two parts: full rows of b, and rows where b may end within a register. `workspace` holds a tile
    /// that overruns c's right edge.
    #[inline(always)]
    fn tile<'a, S: Simd, const R: usize, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        (row, panel): (usize, usize),
        first: bool,
        indices: [impl Iterator<Item = KIndex<'a, E, P>>; 2],
        workspace: &mut [E::Sum],
    ) {
        let (columns, count) = (self.b.columns, Vector::<S, E::Sum>::COUNT);
        let (offset, width) = (panel * W * count, P * W * count);
        let overruns = columns - offset < width;
        let lines = (row..row + R).map(|row| row * columns + offset..(row + 1) * columns);

        // An overrunning tile is computed in the workspace.
        if overruns {
            for (line, workspace) in lines.clone().zip(workspace.chunks_exact_mut(width)) {
                workspace[..line.len()].copy_from_slice(&self.c[line]);
            }
        }
        let (c, stride) =
            if overruns { (&mut workspace[..], width) } else { (&mut self.c[row * columns + offset..], columns) };

        // Load the sums, add to them, store them.
        let mut sums = [[[Vector::splat(simd, E::Sum::ZERO); W]; P]; R];
        if !first {
            for (r, sums) in sums.iter_mut().enumerate() {
                let line = &c[r * stride..][..width];
                for (p, sums) in sums.iter_mut().enumerate() {
                    for (i, sum) in sums.iter_mut().enumerate() {
                        *sum = Vector::load(simd, &line[(p * W + i) * count..][..count]);
                    }
                }
            }
        }
        sums = accumulate_lhs::<S, E, R, P, W>(simd, sums, (self.a, row, self.rows), indices);
        for (r, sums) in sums.iter().enumerate() {
            let line = &mut c[r * stride..][..width];
            for (part, sum) in line.chunks_exact_mut(count).zip(sums.as_flattened()) {
                sum.store(part);
            }
        }

        if overruns {
            for (line, workspace) in lines.zip(workspace.chunks_exact(width)) {
                let count = line.len();
                self.c[line].copy_from_slice(&workspace[..count]);
            }
        }
    }
}

/// True if the registers hold the sums of a tile, besides vectors of b and an element of a.
const fn fits<S: Simd>(rows: usize, vectors: usize) -> bool {
    let sums = match S::REGISTER_COUNT {
        _ if S::IS_SCALAR => 4,
        32.. => 24,
        _ => 12,
    };
    rows * vectors <= sums
}

/// Kernel for tiles of R rows. Its result is the row after them.
#[derive(Debug)]
struct RowTiles<'a, 'b, E: Operand, const R: usize, const W: usize> {
    gemm: &'a mut Gemm<'b, E>,
    rows: Range<usize>,
}

impl<E: Operand, const R: usize, const W: usize> WithSimd for RowTiles<'_, '_, E, R, W> {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> usize {
        let Self { gemm, rows } = self;
        // As a constant: larger tiles are not compiled.
        if const { !fits::<S>(R, W) } {
            return rows.start;
        }

        let b = gemm.b;
        let width = W * Vector::<S, E::Sum>::COUNT;
        let mut workspace = edge_tile(b.columns, width);
        let workspace = workspace.as_mut_slice().as_flattened_mut();

        for panel in 0..b.columns.div_ceil(width) {
            let lines = |indices: Range<usize>| {
                let values = b.panel(panel, width).get(indices.start * b.stride..).unwrap_or_default();
                indices.zip(values.chunks(b.stride)).map(|(k, line)| (k, [line]))
            };
            for row in rows.clone().step_by(R) {
                let indices = [lines(0..b.full_rows), lines(b.full_rows..b.inner)];
                gemm.tile::<S, R, 1, W>(simd, (row, panel), !gemm.accumulate, indices, workspace);
            }
        }
        rows.end
    }
}

/// Kernel for a single row, limited by the bandwidth of reading b: rows of b at zeros of a, frequent after a rectified linear unit,
/// are skipped.
#[derive(Debug)]
struct SingleRow<'a, 'b, E: Operand> {
    gemm: &'a mut Gemm<'b, E>,
    row: usize,
}

impl<E: Operand> WithSimd for SingleRow<'_, '_, E> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let Gemm { a, b: BLayout { inner, full_rows, columns, .. }, accumulate, .. } = *self.gemm;
        let mut workspace = edge_tile(columns, NR_VECTORS * Vector::<S, E::Sum>::COUNT);
        let workspace = workspace.as_mut_slice().as_flattened_mut();
        let (Lhs::Rows(a), SMALL..) = (a, inner * columns) else {
            return self.panels(simd, !accumulate, [0..full_rows, full_rows..inner], workspace);
        };

        // The indices where a is not zero, chunk by chunk.
        let mut indices = [0; CHUNK];
        for start in (0..inner).step_by(CHUNK) {
            let end = inner.min(start + CHUNK);
            let mut count = 0;
            for (k, a) in (start..end).zip(&a[self.row * inner..][start..end]) {
                indices[count] = k;
                count += usize::from(*a != E::ZERO);
            }
            let (full, rest) = indices[..count].split_at(indices[..count].partition_point(|k| *k < full_rows));
            let indices = [full.iter().copied(), rest.iter().copied()];
            self.panels(simd, start == 0 && !accumulate, indices, workspace);
        }
    }
}

impl<E: Operand> SingleRow<'_, '_, E> {
    /// All panels, several at once, so that their sums are independent in the processor's pipeline.
    #[inline(always)]
    fn panels<S: Simd>(
        &mut self,
        simd: S,
        first: bool,
        indices: [impl Iterator<Item = usize> + Clone; 2],
        workspace: &mut [E::Sum],
    ) {
        let panels = self.gemm.b.columns.div_ceil(NR_VECTORS * Vector::<S, E::Sum>::COUNT);
        let mut panel = 0;
        while panel + 4 <= panels {
            self.micro_kernel::<S, 4>(simd, panel, first, indices.clone(), workspace);
            panel += 4;
        }
        while panel + 2 <= panels {
            self.micro_kernel::<S, 2>(simd, panel, first, indices.clone(), workspace);
            panel += 2;
        }
        if panel < panels {
            self.micro_kernel::<S, 1>(simd, panel, first, indices, workspace);
        }
    }

    /// Micro-kernel of a row at P panels, from `panel` on.
    #[inline(always)]
    fn micro_kernel<S: Simd, const P: usize>(
        &mut self,
        simd: S,
        panel: usize,
        first: bool,
        [full, rest]: [impl Iterator<Item = usize>; 2],
        workspace: &mut [E::Sum],
    ) {
        let b = self.gemm.b;
        let mut panels = [b.values; P];
        for (p, values) in panels.iter_mut().enumerate() {
            *values = b.panel(panel + p, NR_VECTORS * Vector::<S, E::Sum>::COUNT);
        }

        let lines = |k: usize| {
            let mut lines = panels;
            for line in &mut lines {
                *line = &line[k * b.stride..];
            }
            (k, lines)
        };
        self.gemm.tile::<S, 1, P, NR_VECTORS>(
            simd,
            (self.row, panel),
            first,
            [full.map(lines), rest.map(lines)],
            workspace,
        );
    }
}

/// Workspace of a tile that overruns the right edge; `None` if no tile does, since zeroing it takes time.
#[inline(always)]
fn edge_tile<T: Element>(columns: usize, width: usize) -> Option<[T; TILE]> {
    if columns.is_multiple_of(width) { None } else { Some([T::ZERO; TILE]) }
}

/// Sums plus the contribution of indices along the inner dimension, for R of a's `count` rows, from `row` on.
#[inline(always)]
fn accumulate_lhs<'a, S: Simd, E: Operand, const R: usize, const P: usize, const W: usize>(
    simd: S,
    mut sums: TileSums<S, E::Sum, R, P, W>,
    (a, row, count): (Lhs<'_, E>, usize, usize),
    [full, rest]: [impl Iterator<Item = KIndex<'a, E, P>>; 2],
) -> TileSums<S, E::Sum, R, P, W> {
    match a {
        Lhs::Rows(values) => {
            let inner = values.len() / count;
            let mut rows = [values; R];
            for (r, values) in rows.iter_mut().enumerate() {
                *values = &values[(row + r) * inner..][..inner];
            }
            let a = |r: usize, k: usize| rows[r][k];
            sums = accumulate::<S, E, R, P, W, true>(simd, sums, full, a);
            accumulate::<S, E, R, P, W, false>(simd, sums, rest, a)
        }
        Lhs::Transposed(values) => {
            let a = |r: usize, k: usize| values[row + k * count..][..R][r];
            sums = accumulate::<S, E, R, P, W, true>(simd, sums, full, a);
            accumulate::<S, E, R, P, W, false>(simd, sums, rest, a)
        }
    }
}

/// Sums plus, for each index k, R elements of a, `a(r, k)`, times P panels of b. Unless FULL, b's rows may end within a register.
#[inline(always)]
fn accumulate<'a, S: Simd, E: Operand, const R: usize, const P: usize, const W: usize, const FULL: bool>(
    simd: S,
    mut sums: TileSums<S, E::Sum, R, P, W>,
    indices: impl Iterator<Item = KIndex<'a, E, P>>,
    a: impl Fn(usize, usize) -> E,
) -> TileSums<S, E::Sum, R, P, W> {
    let count = Vector::<S, E::Sum>::COUNT;
    for (k, lines) in indices {
        for (p, mut line) in lines.into_iter().enumerate() {
            if FULL {
                line = &line[..W * count];
            }
            let part = |i| if FULL { &line[i * count..][..count] } else { line.get(i * count..).unwrap_or_default() };
            let mut b = [E::splat(simd, E::ZERO); W];
            for (i, b) in b.iter_mut().enumerate() {
                *b = E::load(simd, part(i));
            }

            for (r, sums) in sums.iter_mut().enumerate() {
                let a = E::splat(simd, a(r, k));
                for (sum, b) in sums[p].iter_mut().zip(b) {
                    *sum = sum.add_product::<E>(a, b);
                }
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::super::packing::PackedB;
    use super::*;
    use crate::engine::simd::bf16::Bf16x2;
    use crate::engine::simd::buffer::zeros;

    /// Numbers from -1 to 1, none exact in bfloat16.
    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 9973) as f32 / 4986.5 - 1.0001).collect()
    }

    fn nearest_bf16(number: f32) -> f64 {
        f32::from_bits((number.to_bits() + 0x8000) & 0xffff_0000).into()
    }

    fn transposed<T: Copy>(values: &[T], columns: usize) -> Vec<T> {
        (0..columns).flat_map(|c| values.iter().skip(c).step_by(columns).copied()).collect()
    }

    /// a `[rows, inner]` times b `[inner, columns]`.
    fn naive(a: &[f64], b: &[f64], columns: usize) -> Vec<f64> {
        let inner = b.len() / columns;
        let columns = transposed(b, columns);
        let dot = |row: &[f64], column: &[f64]| row.iter().zip(column).map(|(a, b)| a * b).sum();
        a.chunks_exact(inner)
            .flat_map(|row| columns.chunks_exact(inner).map(|column| dot(row, column)).collect::<Vec<_>>())
            .collect()
    }

    fn assert_close(ours: &[impl Copy + Into<f64>], expected: &[f64], tolerance: f64, what: &str) {
        assert_eq!(ours.len(), expected.len());
        for (ours, expected) in ours.iter().zip(expected) {
            let ours: f64 = (*ours).into();
            assert!((ours - expected).abs() < tolerance, "{what}: {ours} for {expected}");
        }
    }

    /// All four combinations of layouts, overwritten and accumulated.
    fn check<T: Element + Into<f64>>(a: &[T], b: &[T], columns: usize, tolerance: f64) {
        let inner = b.len() / columns;
        let rows = a.len() / inner;
        let wide = |values: &[T]| values.iter().map(|value| (*value).into()).collect::<Vec<f64>>();
        let expected = naive(&wide(a), &wide(b), columns);
        let (a_t, b_t) = (transposed(a, inner), transposed(b, columns));
        let packed = PackedB::transposed(&b_t, inner);
        for lhs in [Lhs::Rows(a), Lhs::Transposed(&a_t)] {
            for layout in [BLayout::new(b, columns), packed.layout()] {
                let what = format!("{rows} x {inner} x {columns}, packed: {}, {lhs:?}", layout.packed);
                let mut c = vec![T::from_f64(f64::NAN); rows * columns];
                gemm(false, &mut c, lhs, layout);
                assert_close(&c, &expected, tolerance, &what);
                gemm(true, &mut c, lhs, layout);
                let twice: Vec<_> = expected.iter().map(|value| 2.0 * value).collect();
                assert_close(&c, &twice, 2.0 * tolerance, &what);
            }
        }
    }

    /// All divisions of rows into tiles, and all remainders of columns and inner indices: panels are up to 48 columns wide.
    #[test]
    fn all_tails_agree_with_a_naive_product() {
        for rows in 1..=17 {
            for columns in (1..=50).chain([64, 95, 97]) {
                for inner in [1, 2, 3, 7] {
                    let (a, b) = (numbers(rows * inner, 1), numbers(inner * columns, 2));
                    check(&a, &b, columns, 1e-5);
                }
            }
        }
    }

    #[test]
    fn all_tails_agree_with_a_naive_product_in_float64() {
        for rows in [1, 2, 3, 5, 8, 15] {
            for columns in 1..=26 {
                let inner = 1 + columns % 5;
                let wide = |values: Vec<f32>| values.into_iter().map(f64::from).collect::<Vec<_>>();
                let (a, b) = (wide(numbers(rows * inner, 1)), wide(numbers(inner * columns, 2)));
                check(&a, &b, columns, 1e-12);
            }
        }
    }

    /// b is large enough that a single row is scanned for zeros, in several chunks, the last one short.
    #[test]
    fn a_sparse_row_skips_only_zeros() {
        for (inner, columns) in [(600, 33), (257, 70), (512, 32), (300, 130)] {
            let mut a = numbers(inner, 1);
            a.iter_mut().enumerate().filter(|(k, _)| k % 3 != 0 || (256..300).contains(k)).for_each(|(_, a)| *a = 0.0);
            check(&a, &numbers(inner * columns, 2), columns, 1e-4);
        }
    }

    #[test]
    fn a_row_is_bitwise_independent_of_other_rows() {
        for (inner, columns) in [(37, 19), (300, 70), (512, 64)] {
            let (a, b) = (numbers(23 * inner, 1), numbers(inner * columns, 2));
            let b_t = transposed(&b, columns);
            let packed = PackedB::transposed(&b_t, inner);
            for layout in [BLayout::new(&b, columns), packed.layout()] {
                let mut all = vec![0.0; 23 * columns];
                gemm(false, &mut all, Lhs::Rows(&a), layout);
                for (row, expected) in a.chunks_exact(inner).zip(all.chunks_exact(columns)) {
                    let mut alone = vec![0.0; columns];
                    gemm(false, &mut alone, Lhs::Rows(row), layout);
                    assert_eq!(alone, expected, "{inner} x {columns}");
                }
            }
        }
    }

    #[test]
    fn products_of_pairs_are_those_of_rounded_numbers() {
        for (rows, inner, columns) in [(1, 2, 1), (3, 48, 32), (17, 130, 33), (64, 256, 64), (1, 512, 70)] {
            let (a, b) = (numbers(rows * inner, 1), numbers(inner * columns, 2));
            let rounded = |values: &[f32]| values.iter().copied().map(nearest_bf16).collect::<Vec<_>>();
            let expected = naive(&rounded(&a), &rounded(&b), columns);
            let (a_t, b_t) = (transposed(&a, inner), transposed(&b, columns));
            let mut workspaces = [(); 4].map(|()| zeros(0));
            let [along_k, panels, pairs, a_pairs] = &mut workspaces;
            let along_k = Bf16x2::pack_along_k(&a, along_k);
            let pairs = Bf16x2::pack_row_pairs(&b, columns, pairs);
            let packed = PackedB::transposed(Bf16x2::pack_along_k(&b_t, panels), inner / 2);
            let lefts = [Lhs::Rows(along_k), Lhs::Transposed(Bf16x2::pack_row_pairs(&a_t, rows, a_pairs))];
            for (lhs, b) in lefts.into_iter().flat_map(|a| [(a, packed.layout()), (a, BLayout::new(pairs, columns))]) {
                let mut c = vec![f32::NAN; rows * columns];
                gemm(false, &mut c, lhs, b);
                assert_close(&c, &expected, 1e-4, &format!("{rows} x {inner} x {columns}"));
            }
        }
    }
}
