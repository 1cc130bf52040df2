//! Tensors of a checkpoint as a source of weights.

use crate::archive::{Scalar, Tensors};
use crate::engine::layers::linear::Weights;

impl<T: Scalar> Weights<T> for Tensors {
    fn get(&self, name: &str) -> Vec<T> {
        self[name].elements().expect("weights of this type")
    }
}
