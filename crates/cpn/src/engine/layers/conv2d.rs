//! Convolution of the encoder, followed by a rectified linear unit.

use super::conv2d_params::Conv2dParams;
use super::linear::{Linear, LinearGradient};
use super::passes::Stacked;
use super::relu::relu;
use super::winograd::{Winograd, WinogradWorkspace};
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::Element;
use crate::precision::Precision;

/// A convolution with a rectified linear unit, from `[S, S, C]` to `[S', S', O]`, channels last.
#[derive(Debug)]
pub struct Conv2d<T: Element> {
    algorithm: Algorithm<T>,
    /// S² C.
    pub inputs: usize,
    /// S'² O.
    pub outputs: usize,
}

#[derive(Debug)]
enum Algorithm<T: Element> {
    Winograd(Winograd<T>),
    HalfWinograd(Winograd<T::Half>),
    Im2col(Im2col<T>),
}

/// A linear layer over copied patches of the image, for kernels that minimal filtering does not support.
#[derive(Debug)]
struct Im2col<T> {
    /// Index of each patch's first element in an image, `[S' S']`.
    starts: Vec<usize>,
    /// Offsets of a patch's elements from its first, `[K K C]`.
    offsets: Vec<usize>,
    /// C.
    channels: usize,
    /// From K K C to O.
    linear: Linear<T>,
}

/// Workspace for intermediates between images and outputs, shared by the layers.
#[derive(Debug)]
pub struct Conv2dWorkspace<T: Element> {
    winograd: WinogradWorkspace<T>,
    half_winograd: WinogradWorkspace<T::Half>,
    /// `[S' S', K K C]`.
    patches: AlignedVec<T>,
}

impl<T: Element> Conv2dWorkspace<T> {
    /// An empty workspace, which grows on use.
    pub fn new() -> Self {
        Self { winograd: WinogradWorkspace::new(), half_winograd: WinogradWorkspace::new(), patches: zeros(0) }
    }
}

impl<T: Element> Conv2d<T> {
    /// A convolution of `weight`, `[O, C, K, K]`, and `bias`, `[O]`. Precision applies to minimal filtering; patches are always in
    /// full precision.
    pub fn new(params: Conv2dParams, weight: &[T], bias: &[T], precision: Precision) -> Self {
        let size = params.output_side();
        let half = (precision == Precision::Bfloat16).then(|| Winograd::new(params, weight, bias)).flatten();
        let algorithm = half
            .map(Algorithm::HalfWinograd)
            .or_else(|| Winograd::new(params, weight, bias).map(Algorithm::Winograd))
            .unwrap_or_else(|| Algorithm::Im2col(Im2col::new(params, weight, bias)));
        let inputs = params.side * params.side * params.channels;
        Self { algorithm, inputs, outputs: size * size * bias.len() }
    }

    /// y `[R, S', S', O]` of images x `[R, S, S, C]`, followed by [`PADDING`](super::winograd_transform::PADDING).
    pub fn forward(&self, x: &[T], y: &mut [T], workspace: &mut Conv2dWorkspace<T>) {
        match &self.algorithm {
            Algorithm::Winograd(winograd) => winograd.forward(x, y, &mut workspace.winograd),
            Algorithm::HalfWinograd(winograd) => winograd.forward(x, y, &mut workspace.half_winograd),
            Algorithm::Im2col(im2col) => {
                for (x, y) in x.chunks_exact(self.inputs).zip(y.chunks_exact_mut(self.outputs)) {
                    im2col.linear.forward(im2col.copy(x, &mut workspace.patches), y);
                    relu(y);
                }
            }
        }
    }

    /// First-order backward pass from ŷ, the gradient before the rectified linear unit: adds to the weights' gradient, and writes
    /// x̂ if given.
    pub fn vjp(
        &self,
        x: &[T],
        y_hat: &[T],
        mut x_hat: Option<&mut [T]>,
        gradient: &mut [LinearGradient<T>],
        workspace: &mut Conv2dWorkspace<T>,
    ) {
        match &self.algorithm {
            Algorithm::Winograd(winograd) => winograd.vjp(x, y_hat, x_hat, gradient, &mut workspace.winograd),
            Algorithm::HalfWinograd(winograd) => winograd.vjp(x, y_hat, x_hat, gradient, &mut workspace.half_winograd),
            Algorithm::Im2col(im2col) => {
                for (i, (x, y_hat)) in x.chunks_exact(self.inputs).zip(y_hat.chunks_exact(self.outputs)).enumerate() {
                    let x_hat = x_hat.as_mut().map(|x_hat| &mut x_hat[i * self.inputs..][..self.inputs]);
                    im2col.vjp(x, y_hat, x_hat, &mut gradient[0], &mut workspace.patches);
                }
            }
        }
    }

    /// A zero gradient, one for each linear layer of the algorithm.
    pub fn gradient(&self) -> Vec<LinearGradient<T>> {
        match &self.algorithm {
            Algorithm::Winograd(winograd) => winograd.gradient(),
            Algorithm::HalfWinograd(winograd) => winograd.gradient(),
            Algorithm::Im2col(im2col) => vec![im2col.linear.gradient()],
        }
    }

    /// A gradient in the checkpoint's layout: weight `[O, C, K, K]` and bias `[O]`.
    pub fn in_weights(&self, gradient: &[LinearGradient<T>]) -> [Vec<T>; 2] {
        match &self.algorithm {
            Algorithm::Winograd(winograd) => winograd.in_weights(gradient),
            Algorithm::HalfWinograd(winograd) => winograd.in_weights(gradient),
            Algorithm::Im2col(Im2col { offsets, channels, .. }) => {
                let LinearGradient { weight, bias } = &gradient[0];
                [transpose(weight, offsets.len() / channels, *channels), bias.to_vec()]
            }
        }
    }
}

impl<T: Element> Im2col<T> {
    fn new(params: Conv2dParams, weight: &[T], bias: &[T]) -> Self {
        let (size, Conv2dParams { side, channels, kernel, stride }) = (params.output_side(), params);
        let starts = (0..size).flat_map(|top| (0..size).map(move |left| (top * side + left) * stride * channels));
        let offsets = (0..kernel).flat_map(|row| (0..kernel * channels).map(move |i| row * side * channels + i));
        Self {
            starts: starts.collect(),
            offsets: offsets.collect(),
            channels,
            linear: Linear::new(&transpose(weight, channels, kernel * kernel), bias.to_vec()),
        }
    }

    /// Patches `[S' S', K K C]` of an image `[S, S, C]`.
    fn copy<'a>(&self, x: &[T], patches: &'a mut AlignedVec<T>) -> &'a mut [T] {
        let Self { starts, offsets, .. } = self;
        let patches = resize(patches, starts.len() * offsets.len());
        for (patch, start) in patches.chunks_exact_mut(offsets.len()).zip(starts) {
            patch.iter_mut().zip(offsets).for_each(|(number, offset)| *number = x[start + offset]);
        }
        patches
    }

    fn vjp(
        &self,
        x: &[T],
        y_hat: &[T],
        x_hat: Option<&mut [T]>,
        gradient: &mut LinearGradient<T>,
        patches: &mut AlignedVec<T>,
    ) {
        let Self { starts, offsets, linear, .. } = self;
        let patches = self.copy(x, patches);
        linear.accumulate_all(starts.len(), Stacked { x: patches, y: y_hat }, gradient);

        let Some(x_hat) = x_hat else { return };
        linear.vjp(y_hat, patches);
        x_hat.fill(T::ZERO);
        for (patch, start) in patches.chunks_exact(offsets.len()).zip(starts) {
            patch.iter().zip(offsets).for_each(|(number, offset)| x_hat[start + offset] += *number);
        }
    }
}

/// Transposes consecutive matrices `[C, P]` to `[P, C]`.
pub fn transpose<T: Element>(matrices: &[T], channels: usize, positions: usize) -> Vec<T> {
    let mut transposed = Vec::with_capacity(matrices.len());
    for matrix in matrices.chunks_exact(channels * positions) {
        for p in 0..positions {
            transposed.extend((0..channels).map(|c| matrix[c * positions + p]));
        }
    }
    transposed
}

#[cfg(test)]
mod tests {
    use super::super::winograd_transform::PADDING;
    use super::*;

    /// Numbers from -1 to 1.
    fn numbers(count: usize, seed: usize) -> Vec<f64> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 9973) as f64 / 4986.5 - 1.0).collect()
    }

    /// A reference convolution by its definition, with its operands.
    struct Naive {
        params: Conv2dParams,
        images: usize,
        outputs: usize,
        x: Vec<f64>,
        weight: Vec<f64>,
        bias: Vec<f64>,
    }

    impl Naive {
        fn new(params: Conv2dParams, images: usize, outputs: usize) -> Self {
            let Conv2dParams { side, channels, kernel, .. } = params;
            let mut x = numbers(images * side * side * channels, 1);
            x.extend([f64::NAN; PADDING]);
            let weight = numbers(outputs * channels * kernel * kernel, 2);
            Self { params, images, outputs, x, weight, bias: numbers(outputs, 3) }
        }

        /// All products of the convolution: indices in y, x and the weight.
        fn products(&self) -> impl Iterator<Item = (usize, usize, usize)> {
            let (Conv2dParams { side, channels, kernel, stride }, size) = (self.params, self.params.output_side());
            let (images, outputs) = (self.images, self.outputs);
            let count = images * size * size * outputs;
            (0..count).flat_map(move |y| {
                let (o, left, top, image) =
                    (y % outputs, y / outputs % size, y / outputs / size % size, y / outputs / size / size);
                (0..channels * kernel * kernel).map(move |tap| {
                    let (c, dy, dx) = (tap / kernel / kernel, tap / kernel % kernel, tap % kernel);
                    let pixel = (image * side + top * stride + dy) * side + left * stride + dx;
                    (y, pixel * channels + c, o * channels * kernel * kernel + tap)
                })
            })
        }

        /// y before the rectified linear unit.
        fn forward(&self) -> Vec<f64> {
            let size = self.params.output_side();
            let mut y: Vec<f64> = (0..self.images * size * size).flat_map(|_| self.bias.iter().copied()).collect();
            self.products().for_each(|(at, x, w)| y[at] += self.x[x] * self.weight[w]);
            y
        }

        /// x̂, and the gradients in weight and bias, of ŷ before the rectified linear unit.
        fn vjp(&self, y_hat: &[f64]) -> [Vec<f64>; 3] {
            let mut x_hat = vec![0.0; self.x.len() - PADDING];
            let mut weight = vec![0.0; self.weight.len()];
            for (y, x, w) in self.products() {
                x_hat[x] += y_hat[y] * self.weight[w];
                weight[w] += y_hat[y] * self.x[x];
            }
            let bias = (0..self.outputs).map(|o| y_hat.iter().skip(o).step_by(self.outputs).sum()).collect();
            [x_hat, weight, bias]
        }
    }

    fn assert_close(ours: &[f64], expected: &[f64], tolerance: f64, what: &str) {
        assert_eq!(ours.len(), expected.len(), "{what}");
        let scale = expected.iter().fold(1.0f64, |most, value| most.max(value.abs()));
        for (ours, expected) in ours.iter().zip(expected) {
            assert!((ours - expected).abs() < tolerance * scale, "{what}: {ours} for {expected}");
        }
    }

    /// All passes against the definition; returns the algorithm's name.
    fn check<T: Element + Into<f64>>(naive: &Naive, precision: Precision, tolerance: f64) -> &'static str {
        let narrow = |values: &[f64]| values.iter().map(|value| T::from_f64(*value)).collect::<Vec<T>>();
        let wide = |values: &[T]| values.iter().map(|value| (*value).into()).collect::<Vec<f64>>();
        let conv = Conv2d::new(naive.params, &narrow(&naive.weight), &narrow(&naive.bias), precision);
        let what = format!("{:?}, {} outputs, {} images", naive.params, naive.outputs, naive.images);
        assert_eq!(conv.inputs * naive.images, naive.x.len() - PADDING, "{what}");

        let (x, mut expected, mut workspace) = (narrow(&naive.x), naive.forward(), Conv2dWorkspace::new());
        expected.iter_mut().for_each(|y| *y = y.max(0.0));
        let mut y = vec![T::from_f64(f64::NAN); expected.len()];
        let y_hat = numbers(y.len(), 4);
        let [x_hat, weight, bias] = naive.vjp(&y_hat);
        // Twice, the second time with a used workspace.
        for _ in 0..2 {
            conv.forward(&x, &mut y, &mut workspace);
            assert_close(&wide(&y), &expected, tolerance, &what);
            let mut gradient = conv.gradient();
            let mut our_x_hat = vec![T::from_f64(f64::NAN); x_hat.len()];
            conv.vjp(&x, &narrow(&y_hat), Some(&mut our_x_hat), &mut gradient, &mut workspace);
            assert_close(&wide(&our_x_hat), &x_hat, tolerance, &what);
            let mut without_x_hat = conv.gradient();
            conv.vjp(&x, &narrow(&y_hat), None, &mut without_x_hat, &mut workspace);
            for gradient in [gradient, without_x_hat] {
                let [our_weight, our_bias] = conv.in_weights(&gradient);
                assert_close(&wide(&our_weight), &weight, tolerance, &what);
                assert_close(&wide(&our_bias), &bias, tolerance, &what);
            }
        }
        match conv.algorithm {
            Algorithm::Winograd(_) => "winograd",
            Algorithm::HalfWinograd(_) => "half winograd",
            Algorithm::Im2col(_) => "im2col",
        }
    }

    /// Sizes (side, channels, kernel, stride) supported by minimal filtering, with a multiple of 16 outputs: both numbers of taps,
    /// and images that end with a tile, within one, or with pixels outside all kernels.
    #[test]
    fn minimal_filtering_agrees_with_the_definition() {
        for (side, channels, kernel, stride) in [
            (4, 1, 2, 1),
            (7, 3, 2, 1),
            (9, 2, 3, 1),
            (13, 5, 3, 1),
            (16, 3, 4, 2),
            (17, 2, 6, 2),
            (21, 1, 6, 3),
            (33, 3, 9, 3),
        ] {
            let params = Conv2dParams { side, channels, kernel, stride };
            for (images, outputs) in [(1, 16), (3, 32)] {
                let naive = Naive::new(params, images, outputs);
                assert_eq!(check::<f64>(&naive, Precision::Float32, 1e-12), "winograd", "{params:?}");
                assert_eq!(check::<f32>(&naive, Precision::Float32, 1e-5), "winograd", "{params:?}");
            }
        }
    }

    #[test]
    fn patches_agree_with_the_definition() {
        for (side, channels, kernel, stride, outputs) in [
            (1, 1, 1, 1, 1),
            (5, 3, 1, 1, 16),
            (9, 2, 4, 3, 7),
            (11, 3, 3, 1, 5),
            (10, 1, 8, 2, 16),
            (3, 4, 2, 1, 16),
            (12, 2, 5, 5, 3),
        ] {
            let params = Conv2dParams { side, channels, kernel, stride };
            for images in [1, 3] {
                let naive = Naive::new(params, images, outputs);
                assert_eq!(check::<f64>(&naive, Precision::Float32, 1e-12), "im2col", "{params:?}");
                // Patches stay in full precision.
                assert_eq!(check::<f32>(&naive, Precision::Bfloat16, 1e-5), "im2col", "{params:?}");
            }
        }
    }

    /// bfloat16 has 8 bits; an odd number of inputs cannot be paired, and stays in full precision.
    #[test]
    fn half_precision_is_close() {
        for (channels, algorithm, tolerance) in [(2, "half winograd", 0.03), (3, "winograd", 1e-5)] {
            let params = Conv2dParams { side: 9, channels, kernel: 3, stride: 1 };
            assert_eq!(check::<f32>(&Naive::new(params, 2, 16), Precision::Bfloat16, tolerance), algorithm);
        }
    }

    #[test]
    fn transposing_twice_changes_nothing() {
        let values = numbers(60, 5);
        let transposed = transpose(&values, 3, 4);
        assert_eq!(transposed[..4], [values[0], values[4], values[8], values[1]]);
        assert_eq!(transpose(&transposed, 4, 3), values);
    }
}
