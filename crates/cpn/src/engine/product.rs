//! Products of matrices, by a kernel whose sums do not depend on how many rows there are: each number of a product is summed
//! along the inner dimension in order, so that a row comes out the same, bit for bit, alone or among others.
//!
//! What the kernel keeps in registers is filled in loops of fixed length over slices of fixed length: closures and iterators
//! in their place send it through memory.

use super::matrix::{MORE_REGISTERS, Matrix, REGISTERS};
use crate::engine::simd::element::{Element, Operand};
use crate::engine::simd::vector::{Vector, VectorShape};
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// Numbers of the largest tile: eight rows of a panel.
const TILE: usize = 8 * MORE_REGISTERS * 16;
/// Numbers of a single row that are looked through at once for zeros.
const CHUNK: usize = 256;
/// Numbers of b that are read faster than those of a row are looked through.
const SMALL: usize = 1 << 14;

/// c = a b, added to what is in c if `accumulate`: c is `[rows, columns]`.
pub fn multiply<E: Operand>(accumulate: bool, c: &mut [E::Sum], a: Left<'_, E>, b: Matrix<'_, E>) {
    let mut product = Product { accumulate, rows: c.len() / b.columns, c, a, b };
    product.run();
}

#[derive(Debug)]
struct Product<'a, E: Operand> {
    accumulate: bool,
    rows: usize,
    c: &'a mut [E::Sum],
    a: Left<'a, E>,
    b: Matrix<'a, E>,
}

/// a of a product.
#[derive(Debug, Clone, Copy)]
pub enum Left<'a, E> {
    /// `[rows, inner]`.
    Rows(&'a [E]),
    /// `[inner, rows]`.
    Turned(&'a [E]),
}

/// Sums in registers: of R rows, at P panels of W registers.
type Sums<S, T, const R: usize, const P: usize, const W: usize> = [[[Vector<S, T>; W]; P]; R];

/// A place along the inner dimension, with b's numbers there from each of P panels on.
type Place<'a, E, const P: usize> = (usize, [&'a [E]; P]);

impl<E: Operand> Product<'_, E> {
    fn run(&mut self) {
        let (rows, Matrix { inner, columns, .. }) = (self.rows, self.b);
        let (Left::Rows(a) | Left::Turned(a)) = self.a;
        assert!(self.c.len() == rows * columns && a.len() == rows * inner, "shapes of a product");
        if self.b.side_by_side == MORE_REGISTERS {
            self.rows::<MORE_REGISTERS>();
        } else {
            self.rows::<REGISTERS>();
        }
    }

    /// By panels of W registers.
    fn rows<const W: usize>(&mut self) {
        // As many rows at once as there are registers for their sums, a part of b and a number of a.
        let mut row = 0;
        if VectorShape::of::<E>().registers >= 32 {
            row = self.tiles::<8, W>(row);
        }
        row = self.tiles::<6, W>(row);
        row = self.tiles::<4, W>(row);
        row = self.tiles::<2, W>(row);
        for row in row..self.rows {
            E::dispatch(Row { product: self, row });
        }
    }

    /// As many rows from `row` on as R divides; answers the row after them.
    fn tiles<const R: usize, const W: usize>(&mut self, row: usize) -> usize {
        let end = row + (self.rows - row) / R * R;
        if end > row {
            E::dispatch(Tiles::<E, R, W> { product: self, rows: row..end });
        }
        end
    }

    /// Of R rows of c, at P panels, the part that some places along the inner dimension give: as the first, or added to what
    /// is there. The places are those of whole rows of b, and those where it may end within a register. `room` is for what juts
    /// out over c's right edge.
    #[inline(always)]
    fn tile<'a, S: Simd, const R: usize, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        (row, panel): (usize, usize),
        first: bool,
        places: [impl Iterator<Item = Place<'a, E, P>>; 2],
        room: &mut [E::Sum],
    ) {
        let (columns, count) = (self.b.columns, Vector::<S, E::Sum>::COUNT);
        let (at, width) = (panel * W * count, P * W * count);
        let is_out = columns - at < width;
        let lines = (row..row + R).map(|row| row * columns + at..(row + 1) * columns);
        if is_out {
            for (line, room) in lines.clone().zip(room.chunks_exact_mut(width)) {
                room[..line.len()].copy_from_slice(&self.c[line]);
            }
        }
        let (c, stride) = if is_out { (&mut room[..], width) } else { (&mut self.c[row * columns + at..], columns) };
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
        sums = along::<S, E, R, P, W>(simd, sums, (self.a, row, self.rows), places);
        for (r, sums) in sums.iter().enumerate() {
            let line = &mut c[r * stride..][..width];
            for (part, sum) in line.chunks_exact_mut(count).zip(sums.as_flattened()) {
                sum.store(part);
            }
        }
        if is_out {
            for (line, room) in lines.zip(room.chunks_exact(width)) {
                let count = line.len();
                self.c[line].copy_from_slice(&room[..count]);
            }
        }
    }
}

/// R rows at a time.
#[derive(Debug)]
struct Tiles<'a, 'b, E: Operand, const R: usize, const W: usize> {
    product: &'a mut Product<'b, E>,
    rows: Range<usize>,
}

impl<E: Operand, const R: usize, const W: usize> WithSimd for Tiles<'_, '_, E, R, W> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { product, rows } = self;
        let b = product.b;
        let width = W * Vector::<S, E::Sum>::COUNT;
        let mut room = beyond(b.columns, width);
        let room = room.as_mut_slice().as_flattened_mut();
        for panel in 0..b.columns.div_ceil(width) {
            let lines = |places: Range<usize>| {
                let values = b.panel(panel, width).get(places.start * b.stride..).unwrap_or_default();
                places.zip(values.chunks(b.stride)).map(|(k, line)| (k, [line]))
            };
            for row in rows.clone().step_by(R) {
                let places = [lines(0..b.whole), lines(b.whole..b.inner)];
                product.tile::<S, R, 1, W>(simd, (row, panel), !product.accumulate, places, room);
            }
        }
    }
}

/// A row by itself, which waits for b to be read; half of it need not be where a is what a rectified linear unit left.
#[derive(Debug)]
struct Row<'a, 'b, E: Operand> {
    product: &'a mut Product<'b, E>,
    row: usize,
}

impl<E: Operand> WithSimd for Row<'_, '_, E> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let Product { a, b: Matrix { inner, whole, columns, .. }, accumulate, .. } = *self.product;
        let mut room = beyond(columns, REGISTERS * Vector::<S, E::Sum>::COUNT);
        let room = room.as_mut_slice().as_flattened_mut();
        let (Left::Rows(a), SMALL..) = (a, inner * columns) else {
            return self.panels(simd, !accumulate, [0..whole, whole..inner], room);
        };
        let mut places = [0; CHUNK];
        for start in (0..inner).step_by(CHUNK) {
            let end = inner.min(start + CHUNK);
            let mut count = 0;
            for (k, a) in (start..end).zip(&a[self.row * inner..][start..end]) {
                places[count] = k;
                count += usize::from(*a != E::ZERO);
            }
            let (whole, rest) = places[..count].split_at(places[..count].partition_point(|k| *k < whole));
            let places = [whole.iter().copied(), rest.iter().copied()];
            self.panels(simd, start == 0 && !accumulate, places, room);
        }
    }
}

impl<E: Operand> Row<'_, '_, E> {
    /// Several panels at once, so that no sum waits for the one before.
    #[inline(always)]
    fn panels<S: Simd>(
        &mut self,
        simd: S,
        first: bool,
        places: [impl Iterator<Item = usize> + Clone; 2],
        room: &mut [E::Sum],
    ) {
        let panels = self.product.b.columns.div_ceil(REGISTERS * Vector::<S, E::Sum>::COUNT);
        let mut panel = 0;
        while panel + 4 <= panels {
            self.several::<S, 4>(simd, panel, first, places.clone(), room);
            panel += 4;
        }
        while panel + 2 <= panels {
            self.several::<S, 2>(simd, panel, first, places.clone(), room);
            panel += 2;
        }
        if panel < panels {
            self.several::<S, 1>(simd, panel, first, places, room);
        }
    }

    /// P panels, from this one on.
    #[inline(always)]
    fn several<S: Simd, const P: usize>(
        &mut self,
        simd: S,
        panel: usize,
        first: bool,
        [whole, rest]: [impl Iterator<Item = usize>; 2],
        room: &mut [E::Sum],
    ) {
        let b = self.product.b;
        let mut panels = [b.values; P];
        for (p, values) in panels.iter_mut().enumerate() {
            *values = b.panel(panel + p, REGISTERS * Vector::<S, E::Sum>::COUNT);
        }
        let lines = |k: usize| {
            let mut lines = panels;
            for line in &mut lines {
                *line = &line[k * b.stride..];
            }
            (k, lines)
        };
        self.product.tile::<S, 1, P, REGISTERS>(
            simd,
            (self.row, panel),
            first,
            [whole.map(lines), rest.map(lines)],
            room,
        );
    }
}

/// Room for a tile that juts out over the right edge, if one can: to fill it with zeros takes its time.
#[inline(always)]
fn beyond<T: Element>(columns: usize, width: usize) -> Option<[T; TILE]> {
    if columns.is_multiple_of(width) { None } else { Some([T::ZERO; TILE]) }
}

/// Adds to sums what some places along the inner dimension give.
#[inline(always)]
fn along<'a, S: Simd, E: Operand, const R: usize, const P: usize, const W: usize>(
    simd: S,
    mut sums: Sums<S, E::Sum, R, P, W>,
    (a, row, count): (Left<'_, E>, usize, usize),
    [whole, rest]: [impl Iterator<Item = Place<'a, E, P>>; 2],
) -> Sums<S, E::Sum, R, P, W> {
    match a {
        Left::Rows(values) => {
            let inner = values.len() / count;
            let mut rows = [values; R];
            for (r, values) in rows.iter_mut().enumerate() {
                *values = &values[(row + r) * inner..][..inner];
            }
            let a = |r: usize, k: usize| rows[r][k];
            sums = add::<S, E, R, P, W, true>(simd, sums, whole, a);
            add::<S, E, R, P, W, false>(simd, sums, rest, a)
        }
        Left::Turned(values) => {
            let a = |r: usize, k: usize| values[row + k * count..][..R][r];
            sums = add::<S, E, R, P, W, true>(simd, sums, whole, a);
            add::<S, E, R, P, W, false>(simd, sums, rest, a)
        }
    }
}

/// Adds to the sums, for each place, R numbers of a, which `a` answers, times P panels of b, whose rows may end within a
/// register if they are not WHOLE.
#[inline(always)]
fn add<'a, S: Simd, E: Operand, const R: usize, const P: usize, const W: usize, const WHOLE: bool>(
    simd: S,
    mut sums: Sums<S, E::Sum, R, P, W>,
    places: impl Iterator<Item = Place<'a, E, P>>,
    a: impl Fn(usize, usize) -> E,
) -> Sums<S, E::Sum, R, P, W> {
    let count = Vector::<S, E::Sum>::COUNT;
    for (k, lines) in places {
        for (p, mut line) in lines.into_iter().enumerate() {
            if WHOLE {
                line = &line[..W * count];
            }
            let part = |i| if WHOLE { &line[i * count..][..count] } else { line.get(i * count..).unwrap_or_default() };
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
    use super::super::matrix::Panels;
    use super::*;
    use crate::engine::simd::bf16::Bf16x2;
    use crate::engine::simd::buffer::zeros;

    /// Numbers from -1 to 1, none of which fits bfloat16.
    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 9973) as f32 / 4986.5 - 1.0001).collect()
    }

    fn nearest(number: f32) -> f64 {
        f32::from_bits((number.to_bits() + 0x8000) & 0xffff_0000).into()
    }

    /// a `[rows, inner]` times b `[inner, columns]`, both rounded.
    fn expected(a: &[f32], b: &[f32], columns: usize) -> Vec<f64> {
        let inner = b.len() / columns;
        let columns = turned(b, columns);
        let sum = |row: &[f32], column: &[f32]| row.iter().zip(column).map(|(a, b)| nearest(*a) * nearest(*b)).sum();
        a.chunks_exact(inner)
            .flat_map(|row| columns.chunks_exact(inner).map(|column| sum(row, column)).collect::<Vec<_>>())
            .collect()
    }

    fn turned(values: &[f32], columns: usize) -> Vec<f32> {
        (0..columns).flat_map(|c| values.iter().skip(c).step_by(columns).copied()).collect()
    }

    fn assert_close(ours: &[f32], expected: &[f64], what: &str) {
        for (ours, expected) in ours.iter().zip(expected) {
            assert!((f64::from(*ours) - expected).abs() < 1e-4, "{what}: {ours} for {expected}");
        }
    }

    #[test]
    fn products_are_those_of_rounded_numbers() {
        for (rows, inner, columns) in [(1, 2, 1), (3, 48, 32), (17, 130, 33), (64, 256, 64), (1, 512, 70)] {
            let (a, b) = (numbers(rows * inner, 1), numbers(inner * columns, 2));
            let expected = expected(&a, &b, columns);
            let (a_turned, b_turned) = (turned(&a, inner), turned(&b, columns));
            let mut rooms = [(); 4].map(|()| zeros(0));
            let [along, panels, across, down] = &mut rooms;
            let (along, across) = (Bf16x2::pack_along_k(&a, along), Bf16x2::pack_row_pairs(&b, columns, across));
            let panels = Panels::transposed(Bf16x2::pack_along_k(&b_turned, panels), inner / 2);
            let lefts = [Left::Rows(along), Left::Turned(Bf16x2::pack_row_pairs(&a_turned, rows, down))];
            for (left, b) in lefts.into_iter().flat_map(|a| [(a, panels.matrix()), (a, Matrix::new(across, columns))]) {
                let mut c = vec![f32::NAN; rows * columns];
                multiply(false, &mut c, left, b);
                assert_close(&c, &expected, &format!("{rows} x {inner} x {columns}"));
            }
        }
    }
}
