//! Samples, goals and batches of a training run.

use crate::common::{episode, keep, step};
use cpn::method::Observed;
use cpn::recipe::GoalSampling;
use cpn::{Input, ModelConfig, Preset, Recipe, Training};
use std::collections::{BTreeMap, BTreeSet};
use trainer::training::dataset::Dataset;
use trainer::training::sampler::{Sample, Sampler};

/// Number of steps of each episode; the last step has no action.
const STEPS: [u32; 3] = [9, 23, 14];

fn dataset() -> Dataset {
    let folder = tempfile::tempdir().unwrap();
    for (seed, steps) in STEPS.into_iter().enumerate() {
        keep(folder.path(), &episode("reach", seed as u64, steps));
    }
    Dataset::load(folder.path(), &[], Input::Image).unwrap()
}

fn recipe(change: impl FnOnce(&mut Training)) -> Recipe {
    let mut recipe = Preset::PaperCpn.recipe();
    change(&mut recipe.training);
    recipe
}

#[test]
fn an_epoch_has_each_sample_once_in_an_order_by_seed() {
    let dataset = dataset();
    for samples_per_draw in [1, 4, 100] {
        let recipe = recipe(|training| training.samples_per_draw = samples_per_draw);
        let sampler = Sampler::new(&dataset, &recipe, 7);
        let (first, second) = (sampler.epoch(0), sampler.epoch(1));
        let moments = |samples: &[Sample]| samples.iter().map(|s| (s.episode, s.step)).collect::<BTreeSet<_>>();
        let all = (0..3).flat_map(|e| (0..STEPS[e as usize] - 1).map(move |s| (e, s))).collect::<BTreeSet<_>>();
        assert_eq!((first.len(), moments(&first)), (all.len(), all.clone()));
        assert_eq!(moments(&second), all);
        assert_ne!(first, second);
        assert_eq!(first, Sampler::new(&dataset, &recipe, 7).epoch(0));
        assert_ne!(first, Sampler::new(&dataset, &recipe, 8).epoch(0));
    }
}

#[test]
fn goals_follow_the_recipe() {
    let dataset = dataset();
    let reach = |goals, action_block| {
        let recipe = recipe(|training| (training.goals, training.action_block) = (goals, action_block));
        let samples = Sampler::new(&dataset, &recipe, 7).epoch(0);
        let last = |s: &Sample| STEPS[s.episode as usize] - 1;
        assert!(samples.iter().all(|s| s.goal > s.step && s.goal <= last(s)));
        let at_the_end = samples.iter().filter(|s| s.goal == last(s)).count();
        (samples.iter().map(|s| s.goal - s.step).max().unwrap(), at_the_end, samples.len())
    };
    let (farthest, at_the_end, all) = reach(GoalSampling::Final, 1);
    assert_eq!((farthest, at_the_end), (22, all));
    assert_eq!(reach(GoalSampling::WithinHorizon, 1).0, 5);
    assert_eq!(reach(GoalSampling::WithinHorizon, 2).0, 10);
    let (farthest, at_the_end, all) = reach(GoalSampling::Hindsight, 1);
    assert!(farthest > 10 && at_the_end < all / 2, "{farthest} {at_the_end}");
}

/// Frames, numbers of steps left, actions and mask of a batch against the recordings.
#[test]
fn a_batch_matches_the_recordings() {
    let dataset = dataset();
    let (horizon, size) = (ModelConfig::paper(cpn::MethodKind::Cpn).horizon as u32, 4);
    for (goals, block) in [(GoalSampling::Final, 1), (GoalSampling::Hindsight, 1), (GoalSampling::Final, 3)] {
        let recipe = recipe(|training| (training.goals, training.action_block) = (goals, block));
        let sampler = Sampler::new(&dataset, &recipe, 3);
        let samples = sampler.epoch(0);
        let batch = sampler.batch(0, &samples);

        let frames = batch.frames.observed();
        let distinct: BTreeSet<_> = samples.iter().flat_map(|s| [(s.episode, s.step), (s.episode, s.goal)]).collect();
        assert_eq!(frames.len(), distinct.len(), "each frame once");

        let (actions, mask) = (&batch.actions, &batch.mask);
        for (row, s) in samples.iter().enumerate() {
            let recorded = |number| step("reach", s.episode.into(), STEPS[s.episode as usize], number);
            for (index, number) in [(&batch.observations, s.step), (&batch.goals, s.goal)] {
                let Observed::Image(pixels) = frames[index[row]] else { panic!("an image") };
                assert_eq!(pixels, recorded(number).frame.data());
            }
            assert_eq!(batch.steps_left[row], s.goal - s.step);
            for t in 0..horizon {
                let steps = (s.step + t * block as u32..s.step + (t + 1) * block as u32).filter(|n| *n < s.goal);
                let recorded: Vec<_> = steps.map(|n| recorded(n).action.unwrap()).collect();
                let at = row * horizon as usize + t as usize;
                assert_eq!(mask[at], f32::from(!recorded.is_empty()));
                for i in 0..size {
                    let mean = recorded.iter().map(|action| action[i]).sum::<f32>() / recorded.len().max(1) as f32;
                    assert!((actions[at * size + i] - mean).abs() < 1e-6);
                }
            }
        }
    }
}

/// Samples that are drawn together share their goal's frame.
#[test]
fn samples_drawn_together_share_frames() {
    let dataset = dataset();
    let frames = |samples_per_draw| {
        let recipe = recipe(|training| training.samples_per_draw = samples_per_draw);
        let sampler = Sampler::new(&dataset, &recipe, 3);
        let by_episode = sampler.epoch(0)[..8].iter().fold(BTreeMap::new(), |mut counts, s| {
            *counts.entry(s.episode).or_insert(0) += 1;
            counts
        });
        (sampler.batch(0, &sampler.epoch(0)[..8]).frames.observed().len(), by_episode.len())
    };
    let (frames, episodes) = frames(8);
    assert_eq!((frames, episodes), (9, 1));
}

/// With a dynamics loss, samples drawn together are successive, and a batch has the applied actions and the frame after each.
#[test]
fn a_dynamics_loss_gets_the_applied_actions_and_the_frames_after_them() {
    let dataset = dataset();
    for block in [1, 3] {
        let recipe = recipe(|training| {
            (training.losses.dynamics, training.samples_per_draw, training.action_block) = (1.0, 4, block);
        });
        let sampler = Sampler::new(&dataset, &recipe, 3);
        let samples = sampler.epoch(0);
        let moments: BTreeSet<_> = samples.iter().map(|s| (s.episode, s.step)).collect();
        assert_eq!((moments.len(), samples.len()), (dataset.sample_count(), dataset.sample_count()));
        let successive =
            samples.windows(2).filter(|pair| (pair[0].episode, pair[0].step + 1) == (pair[1].episode, pair[1].step));
        assert!(successive.count() > samples.len() / 2);

        let batch = sampler.batch(0, &samples);
        let (frames, horizon) = (batch.frames.observed(), recipe.model.horizon as usize);
        assert_eq!(batch.next.len(), samples.len() * horizon);
        for (at, (next, mask)) in batch.next.iter().zip(&batch.mask).enumerate().filter(|(_, (_, mask))| **mask > 0.0) {
            let (s, t) = (&samples[at / horizon], at % horizon);
            let after = s.goal.min(s.step + (t + 1) as u32 * block as u32);
            let recorded = step("reach", s.episode.into(), STEPS[s.episode as usize], after);
            let Observed::Image(pixels) = frames[*next] else { panic!("an image") };
            assert_eq!((pixels, *mask), (recorded.frame.data(), 1.0));

            let applied = (s.step + t as u32 * block as u32..after).map(|number| {
                let recorded = step("reach", s.episode.into(), STEPS[s.episode as usize], number);
                recorded.applied_action.or(recorded.action).unwrap()
            });
            let applied: Vec<_> = applied.collect();
            for i in 0..4 {
                let mean = applied.iter().map(|action| action[i]).sum::<f32>() / applied.len() as f32;
                assert!((batch.applied_actions[at * 4 + i] - mean).abs() < 1e-6);
            }
        }
    }
}

/// With a position loss, a batch has the position of the hand in each frame, with mean 0 and standard deviation 1 in the dataset.
#[test]
fn a_position_loss_gets_the_hands_standardised_positions() {
    let dataset = dataset();
    let all = dataset.hand_positions();
    assert_eq!(all.len(), STEPS.iter().sum::<u32>() as usize);
    let moment = |power| all.iter().map(|position| position[0].powi(power)).sum::<f32>() / all.len() as f32;
    // The fixtures' hand moves along the first axis alone.
    assert!(moment(1).abs() < 1e-5 && (moment(2) - 3.0).abs() < 1e-4, "{} {}", moment(1), moment(2));
    assert!(all.iter().all(|position| position[1..].iter().all(|value| value.abs() < 1e-5)));

    let recipe = recipe(|training| training.losses.position = 1.0);
    let sampler = Sampler::new(&dataset, &recipe, 3);
    let samples = sampler.epoch(0);
    let batch = sampler.batch(0, &samples);
    assert_eq!(batch.positions.len(), batch.frames.observed().len());
    for (s, row) in samples.iter().zip(&batch.observations) {
        let first = dataset.episodes()[s.episode as usize].first_frame;
        assert_eq!(batch.positions[*row], all[first + s.step as usize]);
    }
}

/// A run resumed within an epoch gets the batches of an uninterrupted run.
#[test]
fn batches_continue_from_any_step() {
    let dataset = dataset();
    let recipe = recipe(|training| (training.batch_size, training.shift_pixels) = (8, 4));
    let sampler = Sampler::new(&dataset, &recipe, 3);
    let per_epoch = sampler.steps_per_epoch() as usize;
    let all: Vec<_> = sampler.batches(0).take(3 * per_epoch).collect();
    assert_eq!(all.iter().map(|b| b.observations.len()).sum::<usize>(), 3 * dataset.sample_count());
    for start in [1, per_epoch, per_epoch + 2] {
        let later = sampler.batches(start as u64).next().unwrap();
        assert_eq!((&later.frames, &later.actions), (&all[start].frames, &all[start].actions));
    }
}
