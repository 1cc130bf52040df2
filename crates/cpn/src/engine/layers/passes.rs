//! Arguments of a layer's passes. Dot: tangent; bar: gradient of the inner loss; hat: gradient of Φ = ŷᵀy + ȳᵀẏ.

/// Terms of Φ = ŷᵀy + ȳᵀẏ in a double backward pass: the first, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    First,
    Second,
}

/// Inputs of a layer, `[R, inputs]`, with their tangents; in the first order `x_dot` is empty.
#[derive(Debug, Clone, Copy)]
pub struct Primal<'a, T> {
    pub x: &'a [T],
    pub x_dot: &'a [T],
}

/// Gradients in a layer's outputs, `[R, outputs]`: ŷ and, in the second order, ȳ; in the first order `y_bar` is empty.
#[derive(Debug, Clone, Copy)]
pub struct Cotangent<'a, T> {
    pub y_hat: &'a [T],
    pub y_bar: &'a [T],
}

impl<T> Cotangent<'_, T> {
    /// True if Φ has both terms.
    pub fn is_second_order(&self) -> bool {
        !self.y_bar.is_empty()
    }
}

/// Factors of a weight gradient, stacked for one product and packed across their rows: `x` holds x `[R, inputs]`, `y` holds ŷ
/// `[R, outputs]`; in the second order they are followed by ẋ and ȳ.
#[derive(Debug, Clone, Copy)]
pub struct Stacked<'a, E> {
    pub x: &'a [E],
    pub y: &'a [E],
}
