//! The Adam optimiser (Kingma and Ba, 2015) with a state that can be saved, which libtorch's own cannot from here.

use cpn::archive::Tensors;
use cpn::engine::Gradient;
use tch::{Kind, Tensor, nn};

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-8;

/// Weights with the running moments of their gradients.
#[derive(Debug)]
pub struct Adam {
    /// In the order of their names: sums over all weights must not depend on that of the store.
    weights: Vec<Weight>,
    /// Updates made so far.
    steps: i32,
}

#[derive(Debug)]
struct Weight {
    name: String,
    /// The model's own.
    tensor: Tensor,
    value: Vec<f32>,
    mean: Vec<f32>,
    square: Vec<f32>,
}

impl Adam {
    /// An optimiser of all weights of a store, which are float32 and nobody else's to move.
    pub fn new(store: &nn::VarStore) -> Self {
        let weight = |(name, tensor): (String, Tensor)| {
            let value = floats(&tensor);
            Weight { name, tensor, mean: vec![0.0; value.len()], square: vec![0.0; value.len()], value }
        };
        let mut weights: Vec<_> = store.variables().into_iter().map(weight).collect();
        weights.sort_by(|a, b| a.name.cmp(&b.name));
        Self { weights, steps: 0 }
    }

    /// Updates the weights that the gradient knows, by it or, if it is longer than `max_norm`, as much of it. Answers how
    /// long it was.
    pub fn step(&mut self, gradient: &Gradient, learning_rate: f64, max_norm: f64) -> f64 {
        let squares = gradient.weights.values().map(|gradient| squared_norm(gradient));
        let norm = squares.sum::<f64>().sqrt();
        let scale = (max_norm / (norm + 1e-6)).min(1.0) as f32;

        self.steps += 1;
        let bias_1 = 1.0 - f64::from(BETA_1).powi(self.steps);
        let bias_2 = (1.0 - f64::from(BETA_2).powi(self.steps)) as f32;
        let rate = (learning_rate / bias_1) as f32;
        for Weight { name, tensor, value, mean, square } in &mut self.weights {
            let Some(gradient) = gradient.weights.get(name) else { continue };
            let moments = mean.iter_mut().zip(square);
            for ((value, (mean, square)), gradient) in value.iter_mut().zip(moments).zip(gradient) {
                let gradient = gradient * scale;
                *mean = BETA_1 * *mean + (1.0 - BETA_1) * gradient;
                *square = BETA_2 * *square + (1.0 - BETA_2) * gradient * gradient;
                *value -= rate * *mean / ((*square / bias_2).sqrt() + EPSILON);
            }
            copy(value, tensor);
        }
        norm
    }

    /// Weights and moments by name.
    pub fn state(&self) -> Tensors {
        let parts = |weight: &Weight| {
            [("weight", &weight.value), ("mean", &weight.mean), ("square", &weight.square)].map(|(part, values)| {
                (format!("{part}.{}", weight.name), Tensor::from_slice(values).view_as(&weight.tensor))
            })
        };
        self.weights.iter().flat_map(parts).collect()
    }

    /// Puts back what [`Adam::state`] gave after `steps` updates.
    ///
    /// # Errors
    /// Names the tensor that is missing or of another shape.
    pub fn restore(&mut self, state: &Tensors, steps: i32) -> anyhow::Result<()> {
        for Weight { name, tensor, value, mean, square } in &mut self.weights {
            for (part, values) in [("weight", &mut *value), ("mean", mean), ("square", square)] {
                let saved = state.get(&format!("{part}.{name}"));
                let saved = saved.filter(|saved| saved.size() == tensor.size() && saved.kind() == Kind::Float);
                match saved {
                    Some(saved) => *values = floats(saved),
                    None => anyhow::bail!("tensor \"{part}.{name}\": expected {:?}, got none such", tensor.size()),
                }
            }
            copy(value, tensor);
        }
        self.steps = steps;
        Ok(())
    }
}

fn copy(values: &[f32], tensor: &mut Tensor) {
    tch::no_grad(|| tensor.copy_(&Tensor::from_slice(values).view_as(tensor)));
}

fn floats(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.flatten(0, -1)).expect("weights are float32")
}

/// In sums side by side, which the compiler vectorises, each in the same order every time.
fn squared_norm(gradient: &[f32]) -> f64 {
    let mut sums = [0.0; 16];
    for chunk in gradient.chunks(sums.len()) {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            *sum += value * value;
        }
    }
    sums.into_iter().map(f64::from).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use tch::Device;
    use tch::nn::OptimizerConfig;

    /// The same descent by libtorch's optimiser and by ours.
    #[test]
    fn agrees_with_libtorch() {
        let start: Vec<f32> = (0..40).map(|i| 3.0 - 0.2 * i as f32).collect();
        let curvature: Vec<f32> = (0..40).map(|i| 0.1 + 0.2 * i as f32).collect();
        let descend = |ours: bool| {
            let store = nn::VarStore::new(Device::Cpu);
            let weight = store.root().var_copy("w", &Tensor::from_slice(&start));
            let mut library = nn::Adam::default().build(&store, 0.1).expect("an optimiser");
            let mut adam = Adam::new(&store);
            for _ in 0..20 {
                let loss = (&weight * &weight * Tensor::from_slice(&curvature)).sum(None::<Kind>);
                if ours {
                    let in_weight = floats(&Tensor::run_backward(&[loss], &[&weight], false, false)[0]);
                    let weights = BTreeMap::from([("w".to_owned(), in_weight)]);
                    adam.step(&Gradient { loss: 0.0, weights, encoder_seconds: 0.0 }, 0.1, 1.0);
                } else {
                    library.backward_step_clip_norm(&loss, 1.0);
                }
            }
            weight.detach()
        };
        let (ours, library) = (descend(true), descend(false));
        assert!((&ours - &library).abs().max().double_value(&[]) < 1e-4, "{ours} {library}");
    }
}
