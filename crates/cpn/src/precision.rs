//! Precision of the image encoder's products.

use crate::engine::simd::bf16::Bf16x2;
use serde::{Deserialize, Serialize};

/// Precision of the products in the image encoder's convolutions and its last layer; all else is float32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Numbers as they are.
    Float32,
    /// Numbers rounded to 8 bits, whose products are added up in float32: close, and faster where the processor has instructions
    /// for it (AVX512-BF16). Elsewhere slower.
    Bfloat16,
}

impl Precision {
    /// The same, or float32 where the processor has no instructions for bfloat16.
    pub fn where_faster(self) -> Self {
        if Bf16x2::is_fast() { self } else { Self::Float32 }
    }
}
