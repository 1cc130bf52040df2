//! Weights of an agent's variables, as libtorch holds them.

use crate::engine::layers::linear::Weights;
use std::collections::HashMap;
use tch::Tensor;
use tch::kind::Element;

/// An agent's variables by their names in a checkpoint.
#[derive(Debug)]
pub struct Variables<'a>(pub &'a HashMap<String, Tensor>);

impl<T: Element + Copy> Weights<T> for Variables<'_> {
    fn get(&self, name: &str) -> Vec<T> {
        floats(&self.0[name])
    }
}

/// A tensor's numbers, row by row.
///
/// # Panics
/// If the tensor is of another kind than T.
pub fn floats<T: Element + Copy>(tensor: &Tensor) -> Vec<T> {
    Vec::try_from(tensor.flatten(0, -1)).expect("a tensor of the kind that was asked for")
}
