//! Sizes of a convolution.

/// Sizes of a square convolution without padding, in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Conv2dParams {
    /// S, the width and height of the input.
    pub side: usize,
    /// C, the channels of the input.
    pub channels: usize,
    /// K, the width and height of the kernel.
    pub kernel: usize,
    pub stride: usize,
}

impl Conv2dParams {
    /// S', the width and height of the output.
    pub fn output_side(&self) -> usize {
        (self.side - self.kernel) / self.stride + 1
    }
}
