//! The fully connected layer y = a x + b, and the four passes that everything here is made of.

use super::lanes::Lanes;
use super::real::Real;
use gemm::Parallelism;
use pulp::{Arch, Simd, WithSimd};

/// Weights by their names in a checkpoint.
pub trait Weights<T> {
    /// The weight of a name, which must be there, row by row.
    fn get(&self, name: &str) -> Vec<T>;
}

/// A layer's weights.
#[derive(Debug)]
pub struct Linear<T> {
    pub inputs: usize,
    pub outputs: usize,
    /// a, `[outputs, inputs]`.
    weight: Vec<T>,
    /// aᵀ, `[inputs, outputs]`: each product reads the one whose rows it runs along.
    transposed: Vec<T>,
    /// b, `[outputs]`.
    bias: Vec<T>,
}

/// What a loss changes by when the weights do.
#[derive(Debug, Clone)]
pub struct LinearGradient<T> {
    /// `[outputs, inputs]`.
    pub weight: Vec<T>,
    /// `[outputs]`.
    pub bias: Vec<T>,
}

impl<T: Real> Linear<T> {
    /// A layer of a `[outputs, inputs]` and b `[outputs]`.
    pub fn new(weight: Vec<T>, bias: Vec<T>) -> Self {
        let (inputs, outputs) = (weight.len() / bias.len(), bias.len());
        let mut transposed = Vec::with_capacity(weight.len());
        for i in 0..inputs {
            transposed.extend(weight.iter().skip(i).step_by(inputs));
        }
        Self { inputs, outputs, weight, transposed, bias }
    }

    /// The layer of this name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        Self::new(weights.get(&format!("{name}.weight")), weights.get(&format!("{name}.bias")))
    }

    /// a `[outputs, inputs]`.
    pub fn weight(&self) -> &[T] {
        &self.weight
    }

    /// b `[outputs]`.
    pub fn bias(&self) -> &[T] {
        &self.bias
    }

    /// y = a x + b: x `[R, inputs]` to y `[R, outputs]`.
    pub fn forward(&self, x: &[T], y: &mut [T]) {
        for row in y.chunks_exact_mut(self.outputs) {
            row.copy_from_slice(&self.bias);
        }
        multiply(true, y, x, (1, self.inputs), &self.transposed, self.inputs);
    }

    /// ẏ = a ẋ: how y changes as x does.
    pub fn tangent(&self, x_dot: &[T], y_dot: &mut [T]) {
        multiply(false, y_dot, x_dot, (1, self.inputs), &self.transposed, self.inputs);
    }

    /// x̄ += aᵀ ȳ: how a loss changes with x, from how it changes with y.
    pub fn backward(&self, y_bar: &[T], x_bar: &mut [T]) {
        multiply(true, x_bar, y_bar, (1, self.outputs), &self.weight, self.outputs);
    }

    /// Adds ∂Φ/∂a and ∂Φ/∂b to `gradient`, for Φ = ŷᵀy + ȳᵀẏ. `x` and `y` hold the R rows of x and ŷ and, in the second
    /// order, those of ẋ and ȳ after them.
    pub fn accumulate(&self, rows: usize, (x, y): (&[T], &[T]), gradient: &mut LinearGradient<T>) {
        let stacked = x.len() / self.inputs;
        multiply(true, &mut gradient.weight, y, (self.outputs, 1), x, stacked);
        for row in y[..rows * self.outputs].chunks_exact(self.outputs) {
            add(&mut gradient.bias, row);
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: vec![T::ZERO; self.weight.len()], bias: vec![T::ZERO; self.bias.len()] }
    }
}

impl<T> LinearGradient<T> {
    /// Both tensors, by their names in a checkpoint.
    pub fn tensors(&mut self, name: &str) -> Vec<(String, &mut Vec<T>)> {
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

/// `c = a b`, added to what is in c if `accumulate`: c and b row-major, a with a stride along `inner` and one along its
/// rows.
#[allow(unsafe_code, reason = "the library takes pointers; that they stay inside the slices is checked here")]
fn multiply<T: Real>(accumulate: bool, c: &mut [T], a: &[T], (a_inner, a_row): (usize, usize), b: &[T], inner: usize) {
    let (rows, columns) = (a.len() / inner, b.len() / inner);
    let exact = a.len() == rows * inner && b.len() == inner * columns && c.len() == rows * columns;
    let dense = (a_inner, a_row) == (1, inner) || (a_inner, a_row) == (rows, 1);
    assert!(exact && dense, "shapes of a product");
    // SAFETY: each matrix is dense and, by the assertion, exactly as large as its slice; `c` is borrowed mutably, so that
    // it overlaps neither factor.
    unsafe {
        gemm::gemm(
            rows,
            columns,
            inner,
            c.as_mut_ptr(),
            1,
            columns.cast_signed(),
            accumulate,
            a.as_ptr(),
            a_inner.cast_signed(),
            a_row.cast_signed(),
            b.as_ptr(),
            1,
            columns.cast_signed(),
            T::ONE,
            T::ONE,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}
