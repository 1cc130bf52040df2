//! Image augmentation: random shift and colour jitter.

use cpn::images::{BYTES, CHANNELS, SIZE};
use cpn::recipe::Training;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Augmentation of the images of one demonstration in one batch: the same for all, since the difference between observation and
/// goal is the task.
#[derive(Debug, Clone, PartialEq)]
pub struct Augmentation {
    /// Shift down and to the right, in pixels.
    shift: [i32; 2],
    /// Lookup table of values; `None` without colour jitter.
    colours: Option<Box<[u8; 256]>>,
}

impl Augmentation {
    /// A random augmentation, determined by seed, step and episode.
    pub fn draw(training: &Training, seed: u64, step: u64, episode: u32) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // The sampler uses the streams of the epochs' numbers, from 0 on.
        rng.set_stream(u64::MAX - step);
        rng.set_word_pos(u128::from(episode) * 16);
        let max_shift = training.shift_pixels as i32;
        let shift = [(); 2].map(|()| rng.random_range(-max_shift..=max_shift));
        let colours =
            (training.colour_jitter > 0.0).then(|| Box::new(colours(training.colour_jitter as f32, &mut rng)));
        Self { shift, colours }
    }

    /// Appends an augmented copy of a frame, `[84, 84, 3]`. A shift is padded by repeating the edge.
    pub fn append(&self, frame: &[u8], out: &mut Vec<u8>) {
        let start = out.len();
        let (side, channels) = (SIZE as usize, CHANNELS as usize);
        if self.shift == [0; 2] {
            out.extend_from_slice(frame);
        } else {
            let source = |at: usize, shift: i32| (at as i32 - shift).clamp(0, side as i32 - 1) as usize;
            out.reserve(BYTES);
            for y in 0..side {
                let row = &frame[source(y, self.shift[0]) * side * channels..][..side * channels];
                for x in 0..side {
                    out.extend_from_slice(&row[source(x, self.shift[1]) * channels..][..channels]);
                }
            }
        }

        if let Some(colours) = &self.colours {
            for value in &mut out[start..] {
                *value = colours[usize::from(*value)];
            }
        }
    }
}

/// Lookup table of a random change of contrast about the mean value, and of brightness, each by at most the factor 1 ± `jitter`.
fn colours(jitter: f32, rng: &mut impl Rng) -> [u8; 256] {
    let [contrast, brightness] = [(); 2].map(|()| rng.random_range(-jitter..=jitter));
    std::array::from_fn(|value| ((value as f32 - 127.5) * (1.0 + contrast) + 127.5 * (1.0 + brightness)) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Vec<u8> {
        (0..BYTES).map(|i| (i * 31 % 251) as u8).collect()
    }

    fn augmented(augmentation: &Augmentation) -> Vec<u8> {
        let mut out = vec![7];
        augmentation.append(&frame(), &mut out);
        assert_eq!((out.remove(0), out.len()), (7, BYTES));
        out
    }

    fn pixel(frame: &[u8], y: usize, x: usize) -> &[u8] {
        &frame[(y * SIZE as usize + x) * 3..][..3]
    }

    #[test]
    fn the_papers_images_are_not_augmented() {
        assert_eq!(augmented(&Augmentation::draw(&Training::paper(), 1, 2, 3)), frame());
    }

    #[test]
    fn a_shift_moves_pixels_and_repeats_the_edge() {
        let shifted = augmented(&Augmentation { shift: [2, -3], colours: None });
        assert_eq!(pixel(&shifted, 12, 20), pixel(&frame(), 10, 23));
        assert_eq!(pixel(&shifted, 0, 83), pixel(&frame(), 0, 83));
        assert_eq!(pixel(&shifted, 1, 5), pixel(&frame(), 0, 8));
    }

    #[test]
    fn augmentations_differ_by_step_and_episode_and_are_reproducible() {
        let training = Training { shift_pixels: 8, colour_jitter: 0.3, ..Training::paper() };
        let draw = |seed, step, episode| Augmentation::draw(&training, seed, step, episode);
        assert_eq!(draw(1, 2, 3), draw(1, 2, 3));
        for other in [draw(2, 2, 3), draw(1, 3, 3), draw(1, 2, 4)] {
            assert_ne!(draw(1, 2, 3), other);
        }
        let colours = draw(1, 2, 3).colours.expect("jitter");
        assert!(colours.is_sorted() && colours[..] != (0..=255).collect::<Vec<u8>>()[..]);
    }
}
