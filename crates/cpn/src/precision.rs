//! Arithmetic precision of the image encoder.

use crate::engine::simd::bf16::Bf16x2;
use serde::{Deserialize, Serialize};

/// Precision of the products in the image encoder's convolutions and its last layer; all else is float32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Float32.
    Float32,
    /// Factors rounded to bfloat16, with 8 bits of mantissa, and products accumulated in float32: faster on processors with
    /// AVX512-BF16, and slower elsewhere.
    Bfloat16,
}

impl Precision {
    /// This precision; float32 instead of bfloat16 on processors without instructions for it.
    pub fn where_faster(self) -> Self {
        if Bf16x2::is_fast() { self } else { Self::Float32 }
    }
}
