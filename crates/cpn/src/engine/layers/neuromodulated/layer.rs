//! Neuromodulated layer y = (u ⊙ a) x + v ⊙ b, where u = σ(s), s = u_β(x), and likewise v by v_γ.
//!
//! With u' = u (1 - u) and u'' = u' (1 - 2 u), for one sample, output o and input i:
//!
//! - y_o = Σ_i u_oi a_oi x_i + v_o b_o
//! - ẏ_o = Σ_i a_oi (u'_oi ṡ_oi x_i + u_oi ẋ_i) + v'_o ṡ_o b_o
//! - x̄_i = Σ_o ȳ_o u_oi a_oi, and s̄_oi = ȳ_o a_oi u'_oi x_i, the gradient in the gate's outputs
//! - of Φ = ŷᵀy + ȳᵀẏ, with p_oi = ŷ_o x_i + ȳ_o ẋ_i and q_oi = ȳ_o ṡ_oi x_i:
//!   ∂Φ/∂a_oi = u_oi p_oi + u'_oi q_oi, ŝ_oi = a_oi (u'_oi p_oi + u''_oi q_oi), x̂_i = Σ_o a_oi (ŷ_o u_oi + ȳ_o u'_oi ṡ_oi)
//!
//! and for v the same with b for a and 1 for x: a bias is the weight of a constant input 1.

use super::gated_weights::{Adjoints, GatedWeights, GatedWeightsGradient, GatedWeightsTape, Scratch};
use crate::engine::layers::linear::Weights;
use crate::engine::layers::passes::{Cotangent, Primal, Stacked};
use crate::engine::simd::element::Element;

/// The layer's gated weights and biases.
#[derive(Debug)]
pub struct Neuromodulated<T> {
    a: GatedWeights<T>,
    b: GatedWeights<T>,
}

/// Gradient of a loss in weights, biases and their gates.
#[derive(Debug)]
pub struct NeuromodulatedGradient<T> {
    a: GatedWeightsGradient<T>,
    b: GatedWeightsGradient<T>,
}

/// Tape of the layer: intermediates for later passes.
#[derive(Debug)]
pub struct NeuromodulatedTape<T> {
    a: GatedWeightsTape<T>,
    b: GatedWeightsTape<T>,
    /// The input of b: 1 for each row.
    ones: Vec<T>,
    /// The tangent of that input.
    zeros: Vec<T>,
    /// Sink for the gradients in that input, which are not needed.
    sink: Vec<T>,
}

impl<T: Element> Neuromodulated<T> {
    /// The layer of a name in a checkpoint; the first `rectified` of its inputs are outputs of a rectified linear unit.
    pub fn named(name: &str, rectified: usize, weights: &impl Weights<T>) -> Self {
        let [a, b] = ["weight", "bias"].map(|part| weights.get(&format!("{name}.{part}")));
        let gated = |values: &[T], rectified, gate: &str| {
            GatedWeights::new(values, b.len(), rectified, &format!("{name}.{gate}"), weights)
        };
        Self { a: gated(&a, rectified, "u"), b: gated(&b, 0, "v") }
    }

    pub fn inputs(&self) -> usize {
        self.a.inputs
    }

    pub fn outputs(&self) -> usize {
        self.a.outputs
    }

    /// A zero gradient.
    pub fn gradient(&self) -> NeuromodulatedGradient<T> {
        NeuromodulatedGradient { a: self.a.gradient(), b: self.b.gradient() }
    }

    /// A gradient by the weights' names in a checkpoint.
    pub fn in_weights(&self, name: &str, gradient: &NeuromodulatedGradient<T>) -> Vec<(String, Vec<T>)> {
        let mut weights = vec![
            (format!("{name}.weight"), self.a.in_a(&gradient.a)),
            (format!("{name}.bias"), self.b.in_a(&gradient.b)),
        ];
        weights.extend(self.a.gate.in_weights(&format!("{name}.u"), &gradient.a.gate));
        weights.extend(self.b.gate.in_weights(&format!("{name}.v"), &gradient.b.gate));
        weights
    }

    /// A tape for blocks of up to R = `rows` samples.
    pub fn tape(&self, rows: usize) -> NeuromodulatedTape<T> {
        let [zeros, sink] = [vec![T::ZERO; rows], vec![T::ZERO; rows]];
        NeuromodulatedTape { a: self.a.tape(rows), b: self.b.tape(rows), ones: vec![T::ONE; rows], zeros, sink }
    }

    /// y `[R, outputs]` of x `[R, inputs]`.
    pub fn forward(&self, rows: usize, x: &[T], tape: &mut NeuromodulatedTape<T>, y: &mut [T]) {
        y.fill(T::ZERO);
        self.a.forward(rows, x, x, &mut tape.a, y);
        self.b.forward(rows, x, &tape.ones[..rows], &mut tape.b, y);
    }

    /// Adds the gradient in x, of ȳ, to x̄.
    pub fn vjp(
        &self,
        rows: usize,
        x: &[T],
        y_bar: &[T],
        tape: &mut NeuromodulatedTape<T>,
        scratch: &mut Scratch<T>,
        x_bar: &mut [T],
    ) {
        self.a.vjp(rows, x, y_bar, &mut tape.a, scratch, x_bar);
        self.b.vjp(rows, &tape.ones, y_bar, &mut tape.b, scratch, &mut tape.sink);
        self.a.gate.end_vjp(rows, &tape.a.gate, x_bar);
        self.b.gate.end_vjp(rows, &tape.b.gate, x_bar);
    }

    /// The tangent ẏ; `x` holds x and ẋ.
    pub fn jvp(&self, rows: usize, x: &[T], tape: &mut NeuromodulatedTape<T>, y_dot: &mut [T]) {
        let (x, x_dot) = x.split_at(rows * self.inputs());
        y_dot.fill(T::ZERO);
        self.a.jvp(rows, x_dot, Primal { x, x_dot }, &mut tape.a, y_dot);
        self.b.jvp(rows, x_dot, Primal { x: &tape.ones, x_dot: &tape.zeros }, &mut tape.b, y_dot);
    }

    /// Adds the gradient of Φ to x̂ and to the weights' gradient.
    pub fn double_backward(
        &self,
        rows: usize,
        stacked: Stacked<'_, T>,
        tape: &mut NeuromodulatedTape<T>,
        scratch: &mut Scratch<T>,
        x_hat: &mut [T],
        gradient: &mut NeuromodulatedGradient<T>,
    ) {
        let (x, x_dot) = stacked.x.split_at(rows * self.inputs());
        let (y_hat, y_bar) = stacked.y.split_at(rows * self.outputs());
        let cotangent = Cotangent { y_hat, y_bar };

        let adjoints = Adjoints { x_hat: &mut *x_hat, gradient: &mut gradient.a };
        self.a.double_backward(rows, Primal { x, x_dot }, cotangent, &mut tape.a, scratch, adjoints);
        let (primal, adjoints) = (
            Primal { x: &tape.ones, x_dot: &tape.zeros },
            Adjoints { x_hat: &mut tape.sink, gradient: &mut gradient.b },
        );
        self.b.double_backward(rows, primal, cotangent, &mut tape.b, scratch, adjoints);

        self.a.gate.end_double_backward(rows, stacked.x, &tape.a.gate, x_hat, &mut gradient.a.gate);
        self.b.gate.end_double_backward(rows, stacked.x, &tape.b.gate, x_hat, &mut gradient.b.gate);
    }
}

impl<T: Element> NeuromodulatedGradient<T> {
    /// `self += other`.
    pub fn add(&mut self, other: &Self) {
        self.a.add(&other.a);
        self.b.add(&other.b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    /// Step of central differences.
    const STEP: f64 = 1e-5;
    const TOLERANCE: f64 = 1e-7;
    const ROWS: usize = 3;

    struct Named(HashMap<String, Vec<f64>>);

    impl Weights<f64> for Named {
        fn get(&self, name: &str) -> Vec<f64> {
            self.0[name].clone()
        }
    }

    #[derive(Debug, Clone, Copy)]
    struct Sizes {
        inputs: usize,
        outputs: usize,
        hidden: usize,
        rectified: usize,
    }

    /// Numbers from -1 to 1.
    fn numbers(count: usize, seed: usize) -> Vec<f64> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 9973) as f64 / 4986.5 - 1.0).collect()
    }

    fn weights(Sizes { inputs, outputs, hidden, .. }: Sizes) -> Named {
        let sizes = [
            ("weight", outputs * inputs),
            ("bias", outputs),
            ("u.hidden.weight", hidden * inputs),
            ("u.hidden.bias", hidden),
            ("u.output.weight", outputs * inputs * hidden),
            ("u.output.bias", outputs * inputs),
            ("v.hidden.weight", hidden * inputs),
            ("v.hidden.bias", hidden),
            ("v.output.weight", outputs * hidden),
            ("v.output.bias", outputs),
        ];
        let named = sizes.iter().enumerate().map(|(i, (name, size))| (format!("layer.{name}"), numbers(*size, i)));
        Named(named.collect())
    }

    /// x, whose first inputs are outputs of a rectified linear unit, and ẋ, zero where these are zero.
    fn inputs(sizes: Sizes) -> [Vec<f64>; 2] {
        let [mut x, mut x_dot] = [numbers(ROWS * sizes.inputs, 21), numbers(ROWS * sizes.inputs, 22)];
        for i in (0..x.len()).filter(|i| i % sizes.inputs < sizes.rectified) {
            x[i] = x[i].max(0.0);
            x_dot[i] = if x[i] > 0.0 { x_dot[i] } else { 0.0 };
        }
        [x, x_dot]
    }

    /// y and ẏ of one row, by the layer's definition.
    fn naive(Named(weights): &Named, sizes: Sizes, x: &[f64], x_dot: &[f64]) -> [Vec<f64>; 2] {
        let weight = |name: &str| &weights[&format!("layer.{name}")];
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        // Attenuations with their tangents.
        let gate = |name: &str| {
            let [a1, b1, a2, b2] = ["hidden.weight", "hidden.bias", "output.weight", "output.bias"]
                .map(|part| weight(&format!("{name}.{part}")));
            let h: Vec<f64> = a1.chunks(sizes.inputs).zip(b1).map(|(a, b)| dot(a, x) + b).collect();
            let h_dot: Vec<f64> =
                a1.chunks(sizes.inputs).zip(&h).map(|(a, h)| if *h > 0.0 { dot(a, x_dot) } else { 0.0 }).collect();
            let h: Vec<f64> = h.iter().map(|h| h.max(0.0)).collect();
            let attenuation = |(a, b): (&[f64], &f64)| {
                let u = 1.0 / (1.0 + (-dot(a, &h) - b).exp());
                (u, u * (1.0 - u) * dot(a, &h_dot))
            };
            a2.chunks(sizes.hidden).zip(b2).map(attenuation).collect::<Vec<_>>()
        };

        let (u, v) = (gate("u"), gate("v"));
        let (a, b) = (weight("weight"), weight("bias"));

        let mut y = vec![0.0; sizes.outputs];
        let mut y_dot = vec![0.0; sizes.outputs];
        for o in 0..sizes.outputs {
            for i in 0..sizes.inputs {
                let ((u, u_dot), a) = (u[o * sizes.inputs + i], a[o * sizes.inputs + i]);
                y[o] += u * a * x[i];
                y_dot[o] += a * (u_dot * x[i] + u * x_dot[i]);
            }
            y[o] += v[o].0 * b[o];
            y_dot[o] += v[o].1 * b[o];
        }
        [y, y_dot]
    }

    /// y and ẏ of all rows.
    fn naive_rows(weights: &Named, sizes: Sizes, [x, x_dot]: &[Vec<f64>; 2]) -> [Vec<f64>; 2] {
        let rows = x.chunks(sizes.inputs).zip(x_dot.chunks(sizes.inputs));
        let rows: Vec<_> = rows.map(|(x, x_dot)| naive(weights, sizes, x, x_dot)).collect();
        [0, 1].map(|part| rows.iter().flat_map(|row| row[part].clone()).collect())
    }

    /// The derivative of `f` at 0, by central differences.
    fn central(f: impl Fn(f64) -> f64) -> f64 {
        (f(STEP) - f(-STEP)) / (2.0 * STEP)
    }

    #[track_caller]
    fn assert_close(ours: f64, expected: f64, what: &str) {
        assert!((ours - expected).abs() < TOLERANCE * (1.0 + expected.abs()), "{what}: {ours} for {expected}");
    }

    fn phi([y, y_dot]: &[Vec<f64>; 2], y_hat: &[f64], y_bar: &[f64]) -> f64 {
        let terms = y.iter().zip(y_hat).chain(y_dot.iter().zip(y_bar));
        terms.map(|(y, hat)| y * hat).sum()
    }

    fn moved(values: &[f64], index: usize, by: f64) -> Vec<f64> {
        let mut values = values.to_vec();
        values[index] += by;
        values
    }

    fn check(sizes: Sizes) {
        let weights = weights(sizes);
        let layer = Neuromodulated::<f64>::named("layer", sizes.rectified, &weights);
        assert_eq!((layer.inputs(), layer.outputs()), (sizes.inputs, sizes.outputs));
        // A tape for more rows than are used.
        let (mut tape, mut scratch) = (layer.tape(ROWS + 2), Scratch::new());
        let [x, x_dot] = inputs(sizes);
        let stacked_x = [&x[..], &x_dot].concat();
        let size = ROWS * sizes.outputs;
        let (y_hat, y_bar) = (numbers(size, 31), numbers(size, 32));
        let stacked_y = [&y_hat[..], &y_bar].concat();
        let both = [x.clone(), x_dot.clone()];
        let [expected_y, expected_y_dot] = naive_rows(&weights, sizes, &both);

        let mut y = vec![f64::NAN; size];
        layer.forward(ROWS, &x, &mut tape, &mut y);
        y.iter().zip(&expected_y).for_each(|(ours, expected)| assert_close(*ours, *expected, "forward"));

        // Gradients in inactive inputs are undefined.
        let needed: Vec<_> = (0..x.len()).filter(|i| i % sizes.inputs >= sizes.rectified || x[*i] > 0.0).collect();
        let mut x_bar = vec![0.5; x.len()];
        layer.vjp(ROWS, &x, &y_bar, &mut tape, &mut scratch, &mut x_bar);
        for i in &needed {
            let f = |by| phi(&naive_rows(&weights, sizes, &[moved(&x, *i, by), x_dot.clone()]), &y_bar, &[]);
            assert_close(x_bar[*i], 0.5 + central(f), &format!("{sizes:?} vjp {i}"));
        }

        let mut y_dot = vec![f64::NAN; size];
        layer.jvp(ROWS, &stacked_x, &mut tape, &mut y_dot);
        for (o, ours) in y_dot.iter().enumerate() {
            let along = |by: f64| x.iter().zip(&x_dot).map(|(x, x_dot)| x + by * x_dot).collect::<Vec<_>>();
            let f = |by| naive_rows(&weights, sizes, &[along(by), x_dot.clone()])[0][o];
            assert_close(*ours, central(f), &format!("{sizes:?} jvp {o}"));
            assert_close(*ours, expected_y_dot[o], &format!("{sizes:?} jvp {o}"));
        }

        for is_second in [false, true] {
            let stacked =
                if is_second { Stacked { x: &stacked_x, y: &stacked_y } } else { Stacked { x: &x, y: &y_hat } };
            let y_bar = if is_second { &y_bar[..] } else { &[] };
            let mut gradient = layer.gradient();
            let mut x_hat = vec![0.5; x.len()];
            layer.double_backward(ROWS, stacked, &mut tape, &mut scratch, &mut x_hat, &mut gradient);
            for i in &needed {
                let f = |by| phi(&naive_rows(&weights, sizes, &[moved(&x, *i, by), x_dot.clone()]), &y_hat, y_bar);
                assert_close(
                    x_hat[*i],
                    0.5 + central(f),
                    &format!("{sizes:?} double backward, second: {is_second}, {i}"),
                );
            }
            let ours = layer.in_weights("layer", &gradient);
            assert_eq!(ours.len(), weights.0.len());
            for (name, ours) in ours {
                let values = &weights.0[&name];
                assert_eq!(ours.len(), values.len(), "{name}");
                // A sample of the weights.
                for i in (0..values.len()).step_by(values.len().div_ceil(40)) {
                    let f = |by| {
                        let mut others = Named(weights.0.clone());
                        others.0.insert(name.clone(), moved(values, i, by));
                        phi(&naive_rows(&others, sizes, &both), &y_hat, y_bar)
                    };
                    assert_close(ours[i], central(f), &format!("{sizes:?} {name} {i}, second: {is_second}"));
                }
            }
        }
    }

    #[test]
    fn all_passes_are_finite_differences() {
        for (inputs, outputs, hidden, rectified) in
            [(1, 1, 1, 0), (7, 3, 5, 4), (6, 9, 4, 0), (5, 16, 3, 5), (9, 17, 6, 8), (4, 33, 5, 2)]
        {
            check(Sizes { inputs, outputs, hidden, rectified });
        }
    }

    /// A gate whose weights exceed one range.
    #[test]
    fn passes_in_several_ranges_are_finite_differences() {
        let sizes = Sizes { inputs: 7, outputs: 33, hidden: 70, rectified: 5 };
        assert!(Neuromodulated::named("layer", 5, &weights(sizes)).a.gate.range() < 4);
        check(sizes);
    }

    #[test]
    fn gradients_add_up() {
        let sizes = Sizes { inputs: 3, outputs: 2, hidden: 2, rectified: 0 };
        let layer = Neuromodulated::<f64>::named("layer", 0, &weights(sizes));
        let (mut tape, mut scratch) = (layer.tape(ROWS), Scratch::new());
        let [x, _] = inputs(sizes);
        let y_hat = numbers(ROWS * 2, 31);
        layer.forward(ROWS, &x, &mut tape, &mut [0.0; ROWS * 2]);
        let [mut once, mut twice] = [(); 2].map(|()| layer.gradient());
        for gradient in [&mut once, &mut twice] {
            let stacked = Stacked { x: &x, y: &y_hat };
            layer.double_backward(ROWS, stacked, &mut tape, &mut scratch, &mut [0.0; ROWS * 3], gradient);
        }
        twice.add(&once);
        let pairs = layer.in_weights("layer", &once).into_iter().zip(layer.in_weights("layer", &twice));
        for ((name, once), (_, twice)) in pairs {
            assert!(once.iter().any(|value| *value != 0.0), "{name}");
            assert!(once.iter().zip(twice).all(|(once, twice)| 2.0 * once == twice), "{name}");
        }
    }
}
