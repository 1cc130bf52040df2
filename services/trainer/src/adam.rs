//! The Adam optimiser (Kingma and Ba, 2015) with a state that can be saved, which libtorch's own cannot from here.

use cpn::archive::Tensors;
use tch::{Kind, Tensor, nn};

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// Weights with the running moments of their gradients.
#[derive(Debug)]
pub struct Adam {
    weights: Vec<Weight>,
    /// Updates made so far.
    steps: i32,
}

#[derive(Debug)]
struct Weight {
    name: String,
    value: Tensor,
    mean: Tensor,
    square: Tensor,
}

impl Adam {
    /// An optimiser of all weights of a store.
    pub fn new(store: &nn::VarStore) -> Self {
        let mut weights: Vec<_> = store
            .variables()
            .into_iter()
            .map(|(name, value)| Weight { name, mean: value.zeros_like(), square: value.zeros_like(), value })
            .collect();
        // The store is unordered; sums over all weights must not depend on that.
        weights.sort_by(|a, b| a.name.cmp(&b.name));
        Self { weights, steps: 0 }
    }

    /// Updates the weights from their gradients, scaled down to `max_norm` if together they are longer, and clears them.
    /// Answers how long they were.
    pub fn step(&mut self, learning_rate: f64, max_norm: f64) -> f64 {
        let _no_grad = tch::no_grad_guard();
        // A method may leave a weight unused: BC has no step size to learn.
        let used = || self.weights.iter().map(|weight| weight.value.grad()).filter(Tensor::defined);
        let squares: Vec<Tensor> = used().map(|gradient| gradient.square().sum(None::<Kind>)).collect();
        let norm = Tensor::stack(&squares, 0).sum(None::<Kind>).sqrt().double_value(&[]);
        let scale = (max_norm / (norm + 1e-6)).min(1.0);

        self.steps += 1;
        let bias_1 = 1.0 - BETA_1.powi(self.steps);
        let bias_2 = 1.0 - BETA_2.powi(self.steps);
        for Weight { value, mean, square, .. } in &mut self.weights {
            let mut gradient = value.grad();
            if !gradient.defined() {
                continue;
            }
            let _ = gradient.g_mul_scalar_(scale);
            let _ = mean.g_mul_scalar_(BETA_1).g_add_(&(&gradient * (1.0 - BETA_1)));
            let _ = square.g_mul_scalar_(BETA_2).addcmul_(&(&gradient * (1.0 - BETA_2)), &gradient);
            let denominator = (&*square / bias_2).sqrt() + EPSILON;
            let _ = value.g_sub_(&(&*mean / denominator * (learning_rate / bias_1)));
            let _ = gradient.zero_();
        }
        norm
    }

    /// Weights and moments by name.
    pub fn state(&self) -> Tensors {
        let parts = |weight: &Weight| {
            [("weight", &weight.value), ("mean", &weight.mean), ("square", &weight.square)]
                .map(|(part, tensor)| (format!("{part}.{}", weight.name), tensor.detach()))
        };
        self.weights.iter().flat_map(parts).collect()
    }

    /// Puts back what [`Adam::state`] gave after `steps` updates.
    ///
    /// # Errors
    /// Names the tensor that is missing or of another shape.
    pub fn restore(&mut self, state: &Tensors, steps: i32) -> anyhow::Result<()> {
        let _no_grad = tch::no_grad_guard();
        for Weight { name, value, mean, square } in &mut self.weights {
            for (part, tensor) in [("weight", value), ("mean", mean), ("square", square)] {
                let saved = state.get(&format!("{part}.{name}"));
                let saved = saved.filter(|saved| saved.size() == tensor.size() && saved.kind() == tensor.kind());
                match saved {
                    Some(saved) => tensor.copy_(saved),
                    None => anyhow::bail!("tensor \"{part}.{name}\": expected {:?}, got none such", tensor.size()),
                }
            }
        }
        self.steps = steps;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Device;
    use tch::nn::OptimizerConfig;

    /// The same descent by libtorch's optimiser and by ours.
    #[test]
    fn agrees_with_libtorch() {
        let start = Tensor::from_slice(&[3.0f64, -2.0, 0.5]);
        let descend = |ours: bool| {
            let store = nn::VarStore::new(Device::Cpu);
            let weight = store.root().var_copy("w", &start);
            let mut library = nn::Adam::default().build(&store, 0.1).expect("an optimiser");
            let mut adam = Adam::new(&store);
            for _ in 0..20 {
                let loss = (&weight * &weight * Tensor::from_slice(&[1.0f64, 5.0, 0.1])).sum(None::<Kind>);
                if ours {
                    loss.backward();
                    adam.step(0.1, 1.0);
                } else {
                    library.backward_step_clip_norm(&loss, 1.0);
                }
            }
            weight.detach()
        };
        let (ours, library) = (descend(true), descend(false));
        assert!((&ours - &library).abs().max().double_value(&[]) < 1e-6, "{ours} {library}");
    }
}
