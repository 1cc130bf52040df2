//! Weights that a gate attenuates for each sample: what they add to a layer's outputs, y_o = Σ_i u_oi a_oi x_i, and the passes
//! over it. The formulas stand in [`gated`](super::gated).
//!
//! The weights of one input lie together. Where a sample's x_i is what a rectified linear unit has closed, none of them matters,
//! in no pass: x_i is zero, so is ẋ_i, and nobody asks for x̄_i.

use super::gate::{Gate, GateGradient, GateTape};
use super::linear::Weights;
use super::modulation::{Backward, FirstAdjoint, Forward, SecondAdjoint, Tangent};
use super::rectified::Open;
use super::simd::vector;
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::Vector;
use super::sparse::Part;
use pulp::{Arch, Simd};
use std::ops::Range;

/// The weights and their gate.
#[derive(Debug)]
pub struct Attenuated<T> {
    /// I.
    pub inputs: usize,
    /// O.
    pub outputs: usize,
    /// The first of the inputs, which a rectified linear unit left.
    rectified: usize,
    /// a, `[I, O']`: filled up with zeros to whole registers.
    pub a: AlignedVec<T>,
    pub gate: Gate<T>,
}

/// What a loss changes by when they do.
#[derive(Debug)]
pub struct AttenuatedGradient<T> {
    /// `[I, O']`.
    pub a: AlignedVec<T>,
    pub gate: GateGradient<T>,
}

/// What the passes leave for each other. A part of u stands where its blocks would in `[I, R, O']`, row by row; of ṡ likewise.
#[derive(Debug)]
pub struct AttenuatedTape<T> {
    /// Where x is not closed.
    open: Open,
    u: AlignedVec<T>,
    s_dot: AlignedVec<T>,
    pub gate: GateTape<T>,
}

/// Room that no pass needs beyond its end.
#[derive(Debug)]
pub struct Scratch<T> {
    /// ŝ and s̄ of a part.
    s: AlignedVec<T>,
    /// What the parts add to an adjoint of h.
    sums: AlignedVec<T>,
}

impl<T: Element> Scratch<T> {
    /// None: it grows.
    pub fn new() -> Self {
        Self { s: zeros(0), sums: zeros(0) }
    }
}

impl<T: Element> Attenuated<T> {
    /// Of a `[O, I]`, with the gate of a name in a checkpoint.
    pub fn new(a: &[T], outputs: usize, rectified: usize, gate: &str, weights: &impl Weights<T>) -> Self {
        let (inputs, gate) = (a.len() / outputs, Gate::named(gate, weights, outputs));
        let mut turned = zeros(inputs * gate.width());
        for (i, line) in turned.chunks_exact_mut(gate.width()).enumerate() {
            for (o, value) in line[..outputs].iter_mut().enumerate() {
                *value = a[o * inputs + i];
            }
        }
        Self { inputs, outputs, rectified, a: turned, gate }
    }

    pub fn gradient(&self) -> AttenuatedGradient<T> {
        AttenuatedGradient { a: zeros(self.a.len()), gate: self.gate.gradient() }
    }

    /// A gradient in a, `[O, I]`.
    pub fn in_a(&self, gradient: &AttenuatedGradient<T>) -> Vec<T> {
        let places = (0..self.outputs).flat_map(|o| (0..self.inputs).map(move |i| (o, i)));
        places.map(|(o, i)| gradient.a[i * self.width() + o]).collect()
    }

    pub fn tape(&self, rows: usize) -> AttenuatedTape<T> {
        let size = rows * self.inputs * self.width();
        AttenuatedTape { open: Open::new(), u: zeros(size), s_dot: zeros(size), gate: self.gate.tape(rows) }
    }

    /// O'.
    pub fn width(&self) -> usize {
        self.gate.width()
    }

    /// Registers of O'.
    #[inline(always)]
    pub fn registers<S: Simd>(&self) -> usize {
        self.width() / Vector::<S, T>::COUNT
    }

    /// Adds to y what x gives; `seen` is what the gate sees.
    pub fn forward(&self, rows: usize, (seen, x): (&[T], &[T]), tape: &mut AttenuatedTape<T>, y: &mut [T]) {
        let AttenuatedTape { open, u, gate, .. } = tape;
        open.find(x, self.inputs, self.rectified, self.gate.part());
        self.gate.enter(rows, seen, gate);
        for part in self.parts(rows, open) {
            let u = &mut u[self.place(&part)];
            self.gate.forward(&part, gate, &mut Forward { layer: self, part: &part, x, u, y });
        }
    }

    /// Adds to x̄ what ȳ gives, but for what it gives by the gate.
    pub fn backward(
        &self,
        rows: usize,
        (x, y_bar): (&[T], &[T]),
        tape: &mut AttenuatedTape<T>,
        scratch: &mut Scratch<T>,
        x_bar: &mut [T],
    ) {
        let AttenuatedTape { open, u, gate, .. } = tape;
        for part in self.parts(rows, open) {
            let s_bar = resize(&mut scratch.s, rows * part.blocks.len() * self.width());
            let u = &u[self.place(&part)];
            Arch::new().dispatch(Backward { layer: self, part: &part, x, u, y_bar, x_bar, s_bar });
            self.gate.backward(&part, s_bar, &mut scratch.sums, gate);
        }
    }

    /// Adds to ẏ what x and ẋ give; `seen_dot` is how what the gate sees changes.
    pub fn tangent(
        &self,
        rows: usize,
        seen_dot: &[T],
        (x, x_dot): (&[T], &[T]),
        tape: &mut AttenuatedTape<T>,
        y_dot: &mut [T],
    ) {
        let AttenuatedTape { open, u, s_dot, gate } = tape;
        self.gate.enter_tangent(rows, seen_dot, gate);
        for part in self.parts(rows, open) {
            let place = self.place(&part);
            let (u, s_dot) = (&u[place.clone()], &mut s_dot[place]);
            self.gate.tangent(&part, gate, &mut Tangent { layer: self, part: &part, x, x_dot, u, s_dot, y_dot });
        }
    }

    /// Adds to x̂, but for what comes by the gate, and to the gradient, what x and ŷ give and, in the second order, ẋ and ȳ.
    pub fn adjoint(
        &self,
        rows: usize,
        (x, y_hat): (&[T], &[T]),
        second: Option<(&[T], &[T])>,
        tape: &mut AttenuatedTape<T>,
        scratch: &mut Scratch<T>,
        (x_hat, gradient): (&mut [T], &mut AttenuatedGradient<T>),
    ) {
        let AttenuatedTape { open, u, s_dot, gate } = tape;
        for part in self.parts(rows, open) {
            let size = rows * part.blocks.len() * self.width();
            let (s_hat, s_bar) = resize(&mut scratch.s, 2 * size).split_at_mut(size);
            let place = self.place(&part);
            let (u, s_dot, in_a) = (&u[place.clone()], &s_dot[place], &mut *gradient.a);
            let (layer, part, x_hat) = (self, &part, &mut *x_hat);
            let s_bar = match second {
                None => {
                    Arch::new().dispatch(FirstAdjoint { layer, part, x, u, y_hat, x_hat, s_hat, in_a });
                    None
                }
                Some((x_dot, y_bar)) => {
                    let (xs, ys, ss) = ((x, x_dot), (y_hat, y_bar), (&mut *s_hat, &mut *s_bar));
                    Arch::new().dispatch(SecondAdjoint { layer, part, xs, u, s_dot, ys, x_hat, ss, in_a });
                    Some(&*s_bar)
                }
            };
            self.gate.adjoint(part, (s_hat, s_bar), &mut scratch.sums, gate, &mut gradient.gate);
        }
    }

    /// Where what belongs to a part of u stands.
    fn place(&self, part: &Part<'_>) -> Range<usize> {
        let size = part.rows * self.width();
        part.blocks.start * size..part.blocks.end * size
    }

    fn parts<'a>(&self, rows: usize, open: &'a Open) -> impl Iterator<Item = Part<'a>> + use<'a, T> {
        let (inputs, count) = (self.inputs, self.gate.part());
        let part = move |first: usize| Part { rows, blocks: first..inputs.min(first + count), wanted: open };
        (0..inputs).step_by(count).map(part)
    }
}

impl<T: Element> AttenuatedGradient<T> {
    /// Adds another.
    pub fn add(&mut self, other: &Self) {
        vector::add(&mut self.a, &other.a);
        self.gate.add(&other.gate);
    }
}
