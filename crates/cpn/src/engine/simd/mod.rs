//! Registers of the processor: element types, vectors as wide as there are registers for, aligned buffers, bfloat16.

pub mod bf16;
pub mod buffer;
pub mod element;
mod float;
pub mod vector;
