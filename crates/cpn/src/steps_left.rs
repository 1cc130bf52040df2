//! Number of steps left to the goal, as an input of g_θ.

/// Number of steps left from which on the input is 1: more than most demonstrations have.
const SATURATION_STEPS: u32 = 100;

/// k = min(steps left, 100) / 100, from 0 to 1.
pub fn scaled(steps_left: u32) -> f32 {
    steps_left.min(SATURATION_STEPS) as f32 / SATURATION_STEPS as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_input_grows_up_to_a_hundred_steps() {
        assert_eq!([0, 1, 50, 100, 101, u32::MAX].map(scaled), [0.0, 0.01, 0.5, 1.0, 1.0, 1.0]);
    }
}
