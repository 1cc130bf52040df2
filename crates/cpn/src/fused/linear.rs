//! The fully connected layer y = a x + b, and the four passes that everything here is made of.

use super::factor::Factor;
use super::lanes::{Aligned, Lanes, zeros};
use super::matrix::{Matrix, Panels};
use super::product::{Left, multiply};
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// Weights by their names in a checkpoint.
pub trait Weights<T> {
    /// The weight of a name, which must be there, row by row.
    fn get(&self, name: &str) -> Vec<T>;
}

/// A layer's weights, as factors of its products, which T adds up: where these hold two numbers, both sizes are even.
#[derive(Debug)]
pub struct Linear<E, T = E> {
    pub inputs: usize,
    pub outputs: usize,
    /// a, `[outputs, inputs]`, across its rows.
    weight: Aligned<E>,
    /// aᵀ, `[inputs, outputs]`, along a's rows: each product reads the one whose rows it runs along.
    transposed: Panels<E>,
    /// b, `[outputs]`.
    bias: Vec<T>,
}

/// What a loss changes by when the weights do.
#[derive(Debug, Clone)]
pub struct LinearGradient<T> {
    /// `[outputs, inputs]`; of a norm `[Z]`, as the other.
    pub weight: Aligned<T>,
    /// `[outputs]`.
    pub bias: Aligned<T>,
}

impl<T: Real, E: Factor<Sum = T>> Linear<E, T> {
    /// A layer of a `[outputs, inputs]` and b `[outputs]`.
    pub fn new(weight: &[T], bias: Vec<T>) -> Self {
        let (inputs, outputs) = (weight.len() / bias.len(), bias.len());
        let mut room = zeros(0);
        let transposed = Panels::transposed(E::along(weight, &mut room), inputs / E::NUMBERS);
        let weight = Aligned::from_slice(0, E::across(weight, inputs, &mut room));
        Self { inputs, outputs, weight, transposed, bias }
    }

    /// The fewest outputs of which a multiple may be computed without the others.
    pub fn granule(&self) -> usize {
        Panels::<E>::width()
    }

    /// y = a x + b: x `[R, inputs]`, along its rows, to y `[R, outputs]`.
    pub fn forward(&self, x: &[E], y: &mut [T]) {
        for row in y.chunks_exact_mut(self.outputs) {
            row.copy_from_slice(&self.bias);
        }
        multiply(true, y, Left::Rows(x), self.transposed.matrix(self.all()));
    }

    /// All of its outputs.
    pub fn all(&self) -> Range<usize> {
        0..self.outputs
    }

    /// ẏ = a ẋ: how some outputs change as x does.
    pub fn tangent(&self, outputs: Range<usize>, x_dot: &[E], y_dot: &mut [T]) {
        multiply(false, y_dot, Left::Rows(x_dot), self.transposed.matrix(outputs));
    }

    /// x̄ = aᵀ ȳ, added to what is in x̄ if `accumulate`: how a loss changes with x, from how it changes with some outputs.
    pub fn backward(&self, accumulate: bool, outputs: Range<usize>, y_bar: &[E], x_bar: &mut [T]) {
        let weight = &self.weight[outputs.start * self.inputs / E::NUMBERS..outputs.end * self.inputs / E::NUMBERS];
        multiply(accumulate, x_bar, Left::Rows(y_bar), Matrix::new(weight, self.inputs));
    }

    /// Adds ∂Φ/∂a to `gradient`, for Φ = ŷᵀy + ȳᵀẏ over some outputs. `x` and `y` hold, across their rows, those of x and ŷ and,
    /// in the second order, those of ẋ and ȳ after them.
    pub fn accumulate(&self, outputs: Range<usize>, (x, y): (&[E], &[E]), gradient: &mut LinearGradient<T>) {
        let weight = &mut gradient.weight[outputs.start * self.inputs..outputs.end * self.inputs];
        multiply(true, weight, Left::Turned(y), Matrix::new(x, self.inputs));
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: zeros(self.outputs * self.inputs), bias: zeros(self.outputs) }
    }
}

impl<T: Real> Linear<T> {
    /// The layer of this name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        Self::new(&weights.get(&format!("{name}.weight")), weights.get(&format!("{name}.bias")))
    }

    /// a `[outputs, inputs]`.
    pub fn weight(&self) -> &[T] {
        &self.weight
    }

    /// b `[outputs]`.
    pub fn bias(&self) -> &[T] {
        &self.bias
    }

    /// [`Self::accumulate`], and ∂Φ/∂b, which the first R = `rows` of them make.
    pub fn accumulate_all(
        &self,
        outputs: Range<usize>,
        rows: usize,
        (x, y): (&[T], &[T]),
        gradient: &mut LinearGradient<T>,
    ) {
        self.accumulate(outputs.clone(), (x, y), gradient);
        gradient.add_bias(outputs.clone(), &y[..rows * outputs.len()]);
    }
}

impl<T: Real> LinearGradient<T> {
    /// Adds ∂Φ/∂b, from the rows of ŷ, over some outputs.
    pub fn add_bias(&mut self, outputs: Range<usize>, y: &[T]) {
        for row in y.chunks_exact(outputs.len()) {
            add(&mut self.bias[outputs.clone()], row);
        }
    }

    /// Adds another.
    pub fn add(&mut self, other: &Self) {
        add(&mut self.weight, &other.weight);
        add(&mut self.bias, &other.bias);
    }

    /// Both tensors, by their names in a checkpoint.
    pub fn tensors(&mut self, name: &str) -> Vec<(String, &mut Aligned<T>)> {
        vec![(format!("{name}.weight"), &mut self.weight), (format!("{name}.bias"), &mut self.bias)]
    }
}

/// `sum += x`, element by element.
pub fn add<T: Real>(sum: &mut [T], x: &[T]) {
    Arch::new().dispatch(Sum { sum, x });
}

#[derive(Debug)]
struct Sum<'a, T> {
    sum: &'a mut [T],
    x: &'a [T],
}

impl<T: Real> WithSimd for Sum<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let count = Lanes::<S, T>::COUNT;
        for (sum, x) in self.sum.chunks_mut(count).zip(self.x.chunks(count)) {
            Lanes::load(simd, x).add_to(sum);
        }
    }
}
