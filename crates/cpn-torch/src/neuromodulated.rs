//! Neuromodulated fully connected layer (section "Neuromodulated meta-learning").

use tch::Tensor;
use tch::nn::{self, Init, Module};

/// Initial bias of the attenuation networks' outputs: sigmoid(2) = 0.88, so that a layer is almost linear at the start of
/// training.
const GATE_BIAS: f64 = 2.0;

/// The layer y = (u_β(x) ⊙ a) x + v_γ(x) ⊙ b, with an attenuation factor in (0, 1) for each weight and bias, computed from the
/// input.
#[derive(Debug)]
pub struct Neuromodulated {
    linear: nn::Linear,
    u: Gate,
    v: Gate,
}

impl Neuromodulated {
    /// A layer from `inputs` to `outputs`, with `gate_hidden` hidden units in the attenuation networks.
    pub fn new(path: &nn::Path, inputs: i64, outputs: i64, gate_hidden: i64) -> Self {
        Self {
            linear: nn::linear(path, inputs, outputs, Default::default()),
            u: Gate::new(&(path / "u"), inputs, gate_hidden, outputs * inputs),
            v: Gate::new(&(path / "v"), inputs, gate_hidden, outputs),
        }
    }
}

impl Module for Neuromodulated {
    /// y `[B, outputs]` of x `[B, inputs]`.
    fn forward(&self, x: &Tensor) -> Tensor {
        let (outputs, inputs) = self.linear.ws.size2().expect("a linear layer's weight is a matrix");
        let weight = self.u.forward(x).view([-1, outputs, inputs]) * &self.linear.ws;
        let bias = self.linear.bs.as_ref().expect("built with a bias");
        weight.matmul(&x.unsqueeze(-1)).squeeze_dim(-1) + self.v.forward(x) * bias
    }
}

/// Attenuation network u_β or v_γ: two linear layers, with a rectified linear unit between them and a sigmoid at the end.
#[derive(Debug)]
struct Gate {
    hidden: nn::Linear,
    output: nn::Linear,
}

impl Gate {
    fn new(path: &nn::Path, inputs: i64, hidden: i64, outputs: i64) -> Self {
        let output = nn::LinearConfig { bs_init: Some(Init::Const(GATE_BIAS)), ..Default::default() };
        Self {
            hidden: nn::linear(path / "hidden", inputs, hidden, Default::default()),
            output: nn::linear(path / "output", hidden, outputs, output),
        }
    }
}

impl Module for Gate {
    fn forward(&self, x: &Tensor) -> Tensor {
        self.output.forward(&self.hidden.forward(x).relu()).sigmoid()
    }
}
