//! Changes of the images that mean nothing, so that the encoder learns to see past them.

use cpn::images::{BYTES, CHANNELS, SIZE};
use cpn::recipe::Training;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// How the images of one demonstration are changed in one batch: all alike, for where the goal is lies in the difference.
#[derive(Debug, Clone, PartialEq)]
pub struct Look {
    /// Pixels down and to the right.
    shift: [i32; 2],
    /// What each value becomes; none if it stays.
    colours: Option<Box<[u8; 256]>>,
}

impl Look {
    /// Draws a look; the same for the same seed, step and episode.
    pub fn draw(training: &Training, seed: u64, step: u64, episode: u32) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // The samples of an epoch are drawn from the streams of their numbers, far below.
        rng.set_stream(u64::MAX - step);
        rng.set_word_pos(u128::from(episode) * 16);
        let farthest = training.shift_pixels as i32;
        let shift = [(); 2].map(|()| rng.random_range(-farthest..=farthest));
        let colours =
            (training.colour_jitter > 0.0).then(|| Box::new(colours(training.colour_jitter as f32, &mut rng)));
        Self { shift, colours }
    }

    /// Appends a changed copy of a frame `[84, 84, 3]`. What a shift uncovers repeats the edge.
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

/// Contrast about the middle, then brightness, each by up to `jitter`.
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

    fn changed(look: &Look) -> Vec<u8> {
        let mut out = vec![7];
        look.append(&frame(), &mut out);
        assert_eq!((out.remove(0), out.len()), (7, BYTES));
        out
    }

    fn pixel(frame: &[u8], y: usize, x: usize) -> &[u8] {
        &frame[(y * SIZE as usize + x) * 3..][..3]
    }

    #[test]
    fn the_papers_images_stay_as_they_are() {
        assert_eq!(changed(&Look::draw(&Training::paper(), 1, 2, 3)), frame());
    }

    #[test]
    fn a_shift_moves_pixels_and_repeats_the_edge() {
        let shifted = changed(&Look { shift: [2, -3], colours: None });
        assert_eq!(pixel(&shifted, 12, 20), pixel(&frame(), 10, 23));
        assert_eq!(pixel(&shifted, 0, 83), pixel(&frame(), 0, 83));
        assert_eq!(pixel(&shifted, 1, 5), pixel(&frame(), 0, 8));
    }

    #[test]
    fn looks_differ_by_step_and_episode_and_repeat_with_the_seed() {
        let training = Training { shift_pixels: 8, colour_jitter: 0.3, ..Training::paper() };
        let draw = |seed, step, episode| Look::draw(&training, seed, step, episode);
        assert_eq!(draw(1, 2, 3), draw(1, 2, 3));
        for other in [draw(2, 2, 3), draw(1, 3, 3), draw(1, 2, 4)] {
            assert_ne!(draw(1, 2, 3), other);
        }
        let colours = draw(1, 2, 3).colours.expect("jitter");
        assert!(colours.is_sorted() && colours[..] != (0..=255).collect::<Vec<u8>>()[..]);
    }
}
