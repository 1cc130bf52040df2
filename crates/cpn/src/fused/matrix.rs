//! Products of matrices, by a kernel whose sums do not depend on how many rows there are: each number of a product is summed
//! along the inner dimension in order, so that a row comes out the same, bit for bit, alone or among others.

use super::lanes::Lanes;
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};
use std::array;
use std::marker::PhantomData;

/// Registers side by side in a panel.
const REGISTERS: usize = 2;
/// Panels that a single row is multiplied by at once: enough sums side by side that none waits for the one before.
const PANELS: usize = 4;
/// Numbers of a single row that are looked through at once for zeros.
const CHUNK: usize = 64;
/// More numbers than any panel is wide.
const WIDEST: usize = 64;

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
}

impl<'a, T: Real> Matrix<'a, T> {
    /// `[inner, columns]`, row by row.
    pub fn new(values: &'a [T], columns: usize) -> Self {
        Self { values, inner: values.len() / columns, columns, stride: columns, apart: width::<T>() }
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
        let (columns, width) = (values.len() / inner, width::<T>());
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
        let (inner, columns, stride) = (self.inner, self.columns, width::<T>());
        Matrix { values: &self.values, inner, columns, stride, apart: inner * stride }
    }
}

/// c = a b, added to what is in c if `accumulate`: a is `[rows, inner]`, c `[rows, columns]`.
pub fn multiply<T: Real>(accumulate: bool, c: &mut [T], a: &[T], b: Matrix<'_, T>) {
    Arch::new().dispatch(Product { accumulate, c, a, b, turned: false });
}

/// c += aᵀ b: a is `[inner, rows]`, c `[rows, columns]`.
pub fn accumulate_turned<T: Real>(c: &mut [T], a: &[T], b: Matrix<'_, T>) {
    Arch::new().dispatch(Product { accumulate: true, c, a, b, turned: true });
}

/// How wide panels are on this processor.
fn width<T: Real>() -> usize {
    struct Width<T>(PhantomData<T>);
    impl<T: Real> WithSimd for Width<T> {
        type Output = usize;

        #[inline(always)]
        fn with_simd<S: Simd>(self, _simd: S) -> usize {
            REGISTERS * Lanes::<S, T>::COUNT
        }
    }
    Arch::new().dispatch(Width::<T>(PhantomData))
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

impl<T: Real> WithSimd for Product<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let Matrix { inner, columns, .. } = self.b;
        let rows = self.c.len() / columns;
        assert!(self.a.len() == rows * inner && self.c.len() == rows * columns, "shapes of a product");
        let panels = columns.div_ceil(REGISTERS * Lanes::<S, T>::COUNT);
        // As many rows at once as there are registers for their sums, a part of b and a number of a.
        let mut row = 0;
        if S::REGISTER_COUNT >= 32 {
            row = self.tiles::<S, 8>(simd, panels, row, rows);
        }
        row = self.tiles::<S, 6>(simd, panels, row, rows);
        row = self.tiles::<S, 4>(simd, panels, row, rows);
        row = self.tiles::<S, 2>(simd, panels, row, rows);
        // A row by itself is bound by how fast b can be read.
        for row in row..rows {
            let wide = panels - panels % PANELS;
            for panel in (0..wide).step_by(PANELS) {
                self.tile::<S, 1, PANELS>(simd, panel, row);
            }
            for panel in wide..panels {
                self.tile::<S, 1, 1>(simd, panel, row);
            }
        }
    }
}

impl<T: Real> Product<'_, T> {
    /// As many tiles of R rows as there are from `row` on; answers the row after them.
    #[inline(always)]
    fn tiles<S: Simd, const R: usize>(&mut self, simd: S, panels: usize, row: usize, rows: usize) -> usize {
        let end = row + (rows - row) / R * R;
        for panel in 0..panels {
            for row in (row..end).step_by(R) {
                self.tile::<S, R, 1>(simd, panel, row);
            }
        }
        end
    }

    /// R rows of c, from `row` on, at P panels, from `panel` on.
    #[inline(always)]
    fn tile<S: Simd, const R: usize, const P: usize>(&mut self, simd: S, panel: usize, row: usize) {
        let Matrix { inner, columns, stride, apart, values } = self.b;
        let b: [&[T]; P] = array::from_fn(|p| &values[(panel + p) * apart..]);
        let sums = if self.turned {
            let rows = self.a.len() / inner;
            let a = &self.a[row..];
            sums::<S, T, R, P>(simd, inner, |r, k| a[k * rows + r], (b, stride))
        } else {
            let a: [&[T]; R] = array::from_fn(|r| &self.a[(row + r) * inner..][..inner]);
            sums::<S, T, R, P>(simd, inner, |r, k| a[r][k], (b, stride))
        };
        let count = Lanes::<S, T>::COUNT;
        for (r, sums) in sums.iter().enumerate() {
            let line = &mut self.c[(row + r) * columns..][..columns][panel * REGISTERS * count..];
            for (part, sum) in line.chunks_mut(count).zip(sums.as_flattened()) {
                if self.accumulate {
                    sum.add_to(part);
                } else {
                    sum.store(part);
                }
            }
        }
    }
}

/// Along the inner dimension: R rows of a, whose k-th numbers `a` answers, times P panels of b, whose rows are `stride` apart.
#[inline(always)]
fn sums<S: Simd, T: Real, const R: usize, const P: usize>(
    simd: S,
    inner: usize,
    a: impl Fn(usize, usize) -> T,
    (b, stride): ([&[T]; P], usize),
) -> [[[Lanes<S, T>; REGISTERS]; P]; R] {
    let count = Lanes::<S, T>::COUNT;
    let mut sums = [[[Lanes::splat(simd, T::ZERO); REGISTERS]; P]; R];
    let mut padded = [T::ZERO; WIDEST];
    let mut add = |k: usize| {
        for p in 0..P {
            let rest = &b[p][k * stride..];
            let line = match rest.get(..REGISTERS * count) {
                Some(line) => line,
                // Past the end of b's last row there may be nothing to fill the registers with.
                None => {
                    padded[..rest.len()].copy_from_slice(rest);
                    &padded[..REGISTERS * count]
                }
            };
            let b: [_; REGISTERS] = array::from_fn(|i| Lanes::load(simd, &line[i * count..][..count]));
            for (r, sums) in sums.iter_mut().enumerate() {
                let a = Lanes::splat(simd, a(r, k));
                for (sum, b) in sums[p].iter_mut().zip(b) {
                    *sum = a.mul_add(b, *sum);
                }
            }
        }
    };
    if R == 1 && P > 1 {
        // A single row waits for b to be read; half of it need not be where a is what a rectified linear unit left.
        let mut places = [0; CHUNK];
        for start in (0..inner).step_by(CHUNK) {
            let mut count = 0;
            for k in start..inner.min(start + CHUNK) {
                places[count] = k;
                count += usize::from(a(0, k) != T::ZERO);
            }
            places[..count].iter().for_each(|k| add(*k));
        }
    } else {
        (0..inner).for_each(add);
    }
    sums
}
