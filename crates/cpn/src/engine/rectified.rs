//! The rectified linear unit, and what it leaves open.

use crate::engine::simd::element::Element;
use pulp::{Arch, Simd, WithSimd};

/// relu(x), in place. What is not a number stays so, for somebody to see.
pub fn rectify<T: Element>(x: &mut [T]) {
    Arch::new().dispatch(Rectify { x });
}

/// The derivative of [`rectify`] times `x`, where `rectified` is what it left.
pub fn mask<T: Element>(x: &mut [T], rectified: &[T]) {
    Arch::new().dispatch(Mask { x, rectified });
}

/// Which numbers of a row the unit has left open, for each row and part of the columns: what others are multiplied by is not
/// needed, neither forward nor back.
#[derive(Debug)]
pub struct Open {
    rows: usize,
    part: usize,
    /// Where the columns of each part's rows end.
    ends: Vec<usize>,
    columns: Vec<u32>,
}

impl Open {
    /// Of nothing.
    pub fn new() -> Self {
        Self { rows: 0, part: 0, ends: Vec::new(), columns: Vec::new() }
    }

    /// Looks through x, `[R, columns]`, in parts of so many columns. The unit left the first `rectified` of a row; the others
    /// are open whatever they are.
    pub fn find<T: Element>(&mut self, x: &[T], columns: usize, rectified: usize, part: usize) {
        (self.rows, self.part) = (x.len() / columns, part);
        // One more than there can be: what is not open is written all the same, and then written over.
        self.columns.resize(x.len() + 1, 0);
        self.ends.clear();
        self.ends.push(0);
        let mut count = 0;
        for first in (0..columns).step_by(part) {
            for row in x.chunks_exact(columns) {
                let end = columns.min(first + part);
                let rectified = rectified.clamp(first, end);
                for (column, x) in (first..).zip(&row[first..rectified]) {
                    self.columns[count] = column as u32;
                    count += usize::from(*x != T::ZERO);
                }
                for (column, at) in (rectified..end).zip(&mut self.columns[count..]) {
                    *at = column as u32;
                }
                count += end - rectified;
                self.ends.push(count);
            }
        }
    }

    /// The open columns of row r in the part that begins at column `first`.
    #[inline(always)]
    pub fn row(&self, first: usize, r: usize) -> &[u32] {
        let at = first / self.part * self.rows + r;
        &self.columns[self.ends[at]..self.ends[at + 1]]
    }
}

#[derive(Debug)]
struct Rectify<'a, T> {
    x: &'a mut [T],
}

impl<T: Element> WithSimd for Rectify<'_, T> {
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
    rectified: &'a [T],
}

impl<T: Element> WithSimd for Mask<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for (x, rectified) in self.x.iter_mut().zip(self.rectified) {
            *x = if *rectified > T::ZERO { *x } else { T::ZERO };
        }
    }
}
