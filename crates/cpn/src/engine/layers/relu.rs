//! Rectified linear unit, and the active set of its outputs.

use crate::engine::simd::element::Element;
use pulp::{Arch, Simd, WithSimd};

/// The rectified linear unit, in place; NaN stays NaN, so that it is detected.
pub fn relu<T: Element>(x: &mut [T]) {
    Arch::new().dispatch(Relu { x });
}

/// The unit's derivative times `x`, in place, from its outputs `activations`: the vjp of a gradient, and the jvp of a tangent.
pub fn relu_mask<T: Element>(x: &mut [T], activations: &[T]) {
    Arch::new().dispatch(Mask { x, activations });
}

/// Active columns of each row of a matrix, by ranges of columns. The inactive ones are zero after a rectified linear unit, so that
/// no pass needs their weights.
#[derive(Debug)]
pub struct ActiveSet {
    rows: usize,
    /// Number of columns of a range.
    range: usize,
    /// Ends of each range's rows in `columns`.
    ends: Vec<usize>,
    columns: Vec<u32>,
}

impl ActiveSet {
    /// An empty set, before any scan.
    pub fn new() -> Self {
        Self { rows: 0, range: 0, ends: Vec::new(), columns: Vec::new() }
    }

    /// Scans x, `[R, columns]`, in ranges of `range` columns. The first `rectified` columns of a row are outputs of the unit; all
    /// others are active.
    pub fn scan<T: Element>(&mut self, x: &[T], columns: usize, rectified: usize, range: usize) {
        (self.rows, self.range) = (x.len() / columns, range);
        // One more than the maximum: inactive columns are written too, and then overwritten.
        self.columns.resize(x.len() + 1, 0);
        self.ends.clear();
        self.ends.push(0);

        let mut count = 0;
        for first in (0..columns).step_by(range) {
            for row in x.chunks_exact(columns) {
                let end = columns.min(first + range);
                let rectified = rectified.clamp(first, end);
                for (column, x) in (first..).zip(&row[first..rectified]) {
                    self.columns[count] = column as u32;
                    count += usize::from(*x != T::ZERO);
                }
                for (column, active) in (rectified..end).zip(&mut self.columns[count..]) {
                    *active = column as u32;
                }
                count += end - rectified;
                self.ends.push(count);
            }
        }
    }

    /// Active columns of row r in the range from column `first` on.
    #[inline(always)]
    pub fn row(&self, first: usize, r: usize) -> &[u32] {
        let index = first / self.range * self.rows + r;
        &self.columns[self.ends[index]..self.ends[index + 1]]
    }
}

#[derive(Debug)]
struct Relu<'a, T> {
    x: &'a mut [T],
}

impl<T: Element> WithSimd for Relu<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for x in self.x {
            *x = if *x < T::ZERO { T::ZERO } else { *x };
        }
    }
}

#[derive(Debug)]
struct Mask<'a, T> {
    x: &'a mut [T],
    activations: &'a [T],
}

impl<T: Element> WithSimd for Mask<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for (x, activation) in self.x.iter_mut().zip(self.activations) {
            *x = if *activation > T::ZERO { *x } else { T::ZERO };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_unit_keeps_positive_numbers_and_nan() {
        let mut x = [-1.0, 0.0, 2.0, f32::NAN, -0.0, f32::INFINITY];
        relu(&mut x);
        assert_eq!(x[..3], [0.0, 0.0, 2.0]);
        assert!(x[3].is_nan());
        assert_eq!(x[4..], [0.0, f32::INFINITY]);
        let mut gradient = [5.0f32; 6];
        relu_mask(&mut gradient, &x);
        assert_eq!(gradient, [0.0, 0.0, 5.0, 0.0, 0.0, 5.0]);
    }

    /// All range sizes and numbers of rectified columns; a set is reused for other sizes.
    #[test]
    fn the_active_set_is_that_of_a_naive_scan() {
        let mut set = ActiveSet::new();
        for (rows, columns) in [(1, 1), (3, 7), (4, 16), (2, 9)] {
            let number = |i: usize| if i.is_multiple_of(3) || i % 5 == 2 { 0.0 } else { i as f32 };
            let x: Vec<f32> = (0..rows * columns).map(number).collect();
            for range in 1..=columns + 2 {
                for rectified in 0..=columns {
                    set.scan(&x, columns, rectified, range);
                    for first in (0..columns).step_by(range) {
                        for r in 0..rows {
                            let is_active = |c: &usize| *c >= rectified || x[r * columns + c] != 0.0;
                            let range = first..columns.min(first + range);
                            let expected: Vec<_> = range.filter(is_active).map(|c| c as u32).collect();
                            assert_eq!(set.row(first, r), expected, "{rows} x {columns}, {rectified} rectified");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn nan_is_active() {
        let mut set = ActiveSet::new();
        set.scan(&[0.0, f64::NAN, -1.0], 3, 3, 3);
        assert_eq!(set.row(0, 0), [1, 2]);
    }
}
