//! Products of matrices, by a kernel whose sums do not depend on how many rows there are: each number of a product is summed
//! along the inner dimension in order, so that a row comes out the same, bit for bit, alone or among others.

use super::lanes::Lanes;
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};
use std::array;
use std::marker::PhantomData;
use std::ops::Range;

/// Registers side by side in a panel.
const REGISTERS: usize = 2;
/// Numbers of a single row that are looked through at once for zeros.
const CHUNK: usize = 256;
/// Numbers of b that are read faster than those of a row are looked through.
const SMALL: usize = 1 << 14;

/// b of a product, `[inner, columns]`, in panels of as many columns as fill some registers.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a, T> {
    values: &'a [T],
    inner: usize,
    columns: usize,
    /// From a row of a panel to the next.
    stride: usize,
    /// From a panel to the next.
    apart: usize,
    /// Rows whose panels all go on to their ends; past b's end there may be nothing to fill the registers with.
    whole: usize,
}

impl<'a, T: Real> Matrix<'a, T> {
    /// `[inner, columns]`, row by row.
    pub fn new(values: &'a [T], columns: usize) -> Self {
        let (inner, width) = (values.len() / columns, Shape::of::<T>().width);
        let beyond = columns.next_multiple_of(width) - columns;
        let whole = inner.saturating_sub(beyond.div_ceil(columns));
        Self { values, inner, columns, stride: columns, apart: width, whole }
    }
}

/// A matrix laid out panel by panel, so that products read it from one end to the other; the last panel is filled up with
/// zeros.
#[derive(Debug)]
pub struct Panels<T> {
    values: Vec<T>,
    inner: usize,
    columns: usize,
}

impl<T: Real> Panels<T> {
    /// Lays out the transpose of `[columns, inner]`.
    pub fn transposed(values: &[T], inner: usize) -> Self {
        let (columns, width) = (values.len() / inner, Shape::of::<T>().width);
        let mut panels = vec![T::ZERO; inner * columns.next_multiple_of(width)];
        for (panel, rows) in panels.chunks_exact_mut(inner * width).zip(values.chunks(inner * width)) {
            for (j, row) in rows.chunks_exact(inner).enumerate() {
                for (k, value) in row.iter().enumerate() {
                    panel[k * width + j] = *value;
                }
            }
        }
        Self { values: panels, inner, columns }
    }

    /// For a product.
    pub fn matrix(&self) -> Matrix<'_, T> {
        let (inner, columns, stride) = (self.inner, self.columns, Shape::of::<T>().width);
        Matrix { values: &self.values, inner, columns, stride, apart: inner * stride, whole: inner }
    }
}

/// c = a b, added to what is in c if `accumulate`: a is `[rows, inner]`, c `[rows, columns]`.
pub fn multiply<T: Real>(accumulate: bool, c: &mut [T], a: &[T], b: Matrix<'_, T>) {
    Product { accumulate, c, a, b, turned: false }.run();
}

/// c += aᵀ b: a is `[inner, rows]`, c `[rows, columns]`.
pub fn accumulate_turned<T: Real>(c: &mut [T], a: &[T], b: Matrix<'_, T>) {
    Product { accumulate: true, c, a, b, turned: true }.run();
}

/// What suits this processor.
#[derive(Debug, Clone, Copy)]
struct Shape {
    /// Of a panel.
    width: usize,
    /// Registers.
    registers: usize,
}

impl Shape {
    fn of<T: Real>() -> Self {
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

#[derive(Debug)]
struct Product<'a, T> {
    accumulate: bool,
    c: &'a mut [T],
    a: &'a [T],
    b: Matrix<'a, T>,
    /// Whether a is `[inner, rows]`.
    turned: bool,
}

impl<T: Real> Product<'_, T> {
    fn run(mut self) {
        let Matrix { inner, columns, .. } = self.b;
        let rows = self.c.len() / columns;
        assert!(self.a.len() == rows * inner && self.c.len() == rows * columns, "shapes of a product");
        // As many rows at once as there are registers for their sums, a part of b and a number of a.
        let mut row = 0;
        if Shape::of::<T>().registers >= 32 {
            row = self.tiles::<8>(row);
        }
        row = self.tiles::<6>(row);
        row = self.tiles::<4>(row);
        row = self.tiles::<2>(row);
        for row in row..rows {
            Arch::new().dispatch(Row { product: &mut self, row });
        }
    }

    /// As many rows from `row` on as R divides; answers the row after them.
    fn tiles<const R: usize>(&mut self, row: usize) -> usize {
        let rows = self.c.len() / self.b.columns;
        let end = row + (rows - row) / R * R;
        if end > row {
            Arch::new().dispatch(Tiles::<T, R> { product: self, rows: row..end });
        }
        end
    }

    /// Of R rows of c, at P panels, the part that some places along the inner dimension give: as the first, or added to what
    /// is there. The places are those of whole rows of b, and others.
    #[inline(always)]
    fn tile<S: Simd, const R: usize, const P: usize>(
        &mut self,
        simd: S,
        (row, panel): (usize, usize),
        first: bool,
        [whole, rest]: [impl Iterator<Item = usize>; 2],
    ) {
        let Matrix { inner, columns, stride, apart, values, .. } = self.b;
        let count = Lanes::<S, T>::COUNT;
        let at = panel * REGISTERS * count;
        let mut sums = [[[Lanes::splat(simd, T::ZERO); REGISTERS]; P]; R];
        if !first {
            for (r, sums) in sums.iter_mut().enumerate() {
                let line = &self.c[(row + r) * columns..][..columns][at..];
                for (part, sum) in line.chunks(count).zip(sums.as_flattened_mut()) {
                    *sum = Lanes::load(simd, part);
                }
            }
        }
        let mut b = [values; P];
        for (p, b) in b.iter_mut().enumerate() {
            *b = &values[(panel + p) * apart..];
        }
        if self.turned {
            let (rows, a) = (self.a.len() / inner, &self.a[row..]);
            let a = |r, k| a[k * rows + r];
            sums = add::<S, T, R, P, true>(simd, sums, whole, a, (b, stride));
            sums = add::<S, T, R, P, false>(simd, sums, rest, a, (b, stride));
        } else {
            let lines: [&[T]; R] = array::from_fn(|r| &self.a[(row + r) * inner..][..inner]);
            let a = |r: usize, k: usize| lines[r][k];
            sums = add::<S, T, R, P, true>(simd, sums, whole, a, (b, stride));
            sums = add::<S, T, R, P, false>(simd, sums, rest, a, (b, stride));
        }
        for (r, sums) in sums.iter().enumerate() {
            let line = &mut self.c[(row + r) * columns..][..columns][at..];
            for (part, sum) in line.chunks_mut(count).zip(sums.as_flattened()) {
                sum.store(part);
            }
        }
    }
}

/// R rows at a time.
#[derive(Debug)]
struct Tiles<'a, 'b, T, const R: usize> {
    product: &'a mut Product<'b, T>,
    rows: Range<usize>,
}

impl<T: Real, const R: usize> WithSimd for Tiles<'_, '_, T, R> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { product, rows } = self;
        let Matrix { inner, whole, columns, .. } = product.b;
        for panel in 0..columns.div_ceil(REGISTERS * Lanes::<S, T>::COUNT) {
            for row in rows.clone().step_by(R) {
                product.tile::<S, R, 1>(simd, (row, panel), !product.accumulate, [0..whole, whole..inner]);
            }
        }
    }
}

/// A row by itself, which waits for b to be read; half of it need not be where a is what a rectified linear unit left.
#[derive(Debug)]
struct Row<'a, 'b, T> {
    product: &'a mut Product<'b, T>,
    row: usize,
}

impl<T: Real> WithSimd for Row<'_, '_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let Product { a, b: Matrix { inner, whole, columns, .. }, turned, accumulate, .. } = *self.product;
        if turned || inner * columns < SMALL {
            return self.panels(simd, !accumulate, [0..whole, whole..inner]);
        }
        let mut places = [0; CHUNK];
        for start in (0..inner).step_by(CHUNK) {
            let end = inner.min(start + CHUNK);
            let mut count = 0;
            for (k, a) in (start..end).zip(&a[self.row * inner..][start..end]) {
                places[count] = k;
                count += usize::from(*a != T::ZERO);
            }
            let (whole, rest) = places[..count].split_at(places[..count].partition_point(|k| *k < whole));
            self.panels(simd, start == 0 && !accumulate, [whole.iter().copied(), rest.iter().copied()]);
        }
    }
}

impl<T: Real> Row<'_, '_, T> {
    /// Several panels at once, so that no sum waits for the one before.
    #[inline(always)]
    fn panels<S: Simd>(&mut self, simd: S, first: bool, places: [impl Iterator<Item = usize> + Clone; 2]) {
        let panels = self.product.b.columns.div_ceil(REGISTERS * Lanes::<S, T>::COUNT);
        let mut panel = 0;
        while panel + 4 <= panels {
            self.product.tile::<S, 1, 4>(simd, (self.row, panel), first, places.clone());
            panel += 4;
        }
        while panel + 2 <= panels {
            self.product.tile::<S, 1, 2>(simd, (self.row, panel), first, places.clone());
            panel += 2;
        }
        if panel < panels {
            self.product.tile::<S, 1, 1>(simd, (self.row, panel), first, places);
        }
    }
}

/// Adds to the sums, for each place k along the inner dimension, R rows of a, whose numbers `a` answers, times P panels of b,
/// whose rows are `stride` apart.
#[inline(always)]
fn add<S: Simd, T: Real, const R: usize, const P: usize, const WHOLE: bool>(
    simd: S,
    mut sums: [[[Lanes<S, T>; REGISTERS]; P]; R],
    places: impl Iterator<Item = usize>,
    a: impl Fn(usize, usize) -> T,
    (b, stride): ([&[T]; P], usize),
) -> [[[Lanes<S, T>; REGISTERS]; P]; R] {
    let count = Lanes::<S, T>::COUNT;
    for k in places {
        for (p, b) in b.iter().enumerate() {
            let mut line = &b[k * stride..];
            if WHOLE {
                line = &line[..REGISTERS * count];
            }
            let part = |i| if WHOLE { &line[i * count..][..count] } else { line.get(i * count..).unwrap_or_default() };
            let b: [_; REGISTERS] = array::from_fn(|i| Lanes::load(simd, part(i)));
            for (r, sums) in sums.iter_mut().enumerate() {
                let a = Lanes::splat(simd, a(r, k));
                for (sum, b) in sums[p].iter_mut().zip(b) {
                    *sum = a.mul_add(b, *sum);
                }
            }
        }
    }
    sums
}
