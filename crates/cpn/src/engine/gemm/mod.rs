//! General matrix multiplication: the layouts of its operands and the kernel.

pub mod kernel;
pub mod packing;
