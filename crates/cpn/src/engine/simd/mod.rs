//! SIMD: element types, vectors of the processor's width, aligned buffers, bfloat16.

pub mod bf16;
pub mod buffer;
pub mod element;
mod float;
pub mod vector;
