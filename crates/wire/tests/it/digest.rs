//! Digests: agreement with the Python package, and sensitivity to every part.

use wire::Image;
use wire::demonstration::{DemonstrationStep, digest};

/// The episode that `tests/golden/episode_digest.json` describes.
fn steps() -> Vec<DemonstrationStep> {
    let step = |n: u32| {
        let pixels = (0..84 * 84 * 3).map(|i| ((7 * i + 13 * n) % 256) as u8).collect();
        DemonstrationStep {
            episode_id: "golden".into(),
            step: n,
            frame: Image::new(84, 84, pixels).unwrap(),
            action: (n < 2).then(|| vec![0.5, -0.25, n as f32, 1.0]),
            applied_action: (n == 1).then(|| vec![-0.5, 0.25, -1.0, -1.0]),
            state: vec![n as f32 + 0.5, -1.0],
            reward: n as f32 * 0.125,
            success: n == 2,
        }
    };
    (0..3).map(step).collect()
}

#[test]
fn the_digest_of_an_episode_matches_the_golden_one() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/episode_digest.json");
    let golden: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(digest(&steps()), golden["digest"]);
}

#[test]
fn the_digest_depends_on_every_part_of_a_step() {
    let whole = digest(&steps());
    let spoils: [fn(&mut DemonstrationStep); 6] = [
        |step| step.frame = Image::new(84, 84, vec![0; 84 * 84 * 3]).unwrap(),
        |step| step.action.as_mut().unwrap()[2] += 0.5,
        |step| step.applied_action = Some(vec![0.0; 4]),
        |step| step.state[1] = 1.0,
        |step| step.reward = 0.5,
        |step| step.success = true,
    ];
    for (number, spoil) in spoils.iter().enumerate() {
        let mut steps = steps();
        spoil(&mut steps[0]);
        assert_ne!(digest(&steps), whole, "part {number}");
    }
}

/// Protobuf drops the sign of a zero, so the digest must ignore it.
#[test]
fn a_reward_of_minus_zero_is_zero() {
    let [whole, mut negative] = [steps(), steps()];
    negative[0].reward = -0.0;
    assert_eq!(whole[0].reward, 0.0);
    assert_eq!(digest(&negative), digest(&whole));
}

#[test]
fn pictures_rendered_differently_are_different_goals() {
    let picture = || Image::new(2, 2, vec![9; 12]).unwrap();
    let soft = picture().rendered_as(r#"{"shadows":"soft"}"#).unwrap();
    assert_ne!(soft, picture());
    assert_ne!(soft.digest(), picture().digest());
    assert_eq!(soft.digest(), picture().rendered_as(r#"{"shadows":"soft"}"#).unwrap().digest());
}
