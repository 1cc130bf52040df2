//! Metrics of training runs.

use crate::runs::Runs;
use metrics::{counter, gauge};
use wire::training::{Progress, Run, RunState};

/// Updates the metrics of all runs at every change.
pub(crate) async fn follow(runs: Runs) {
    let mut changes = runs.changes();
    while let Some(changed) = changes.next().await {
        changed.iter().for_each(update);
    }
}

fn update(Run { name, state, progress }: &Run) {
    let run = || name.clone();
    gauge!("cpn_training_running", "run" => run()).set(if *state == RunState::Running { 1.0 } else { 0.0 });
    let Some(progress) = progress else { return };
    let Progress { step, steps, epoch, samples, loss, learning_rate, gradient_norm, samples_per_second, .. } =
        *progress;
    counter!("cpn_training_steps_total", "run" => run()).absolute(step);
    counter!("cpn_training_samples_total", "run" => run()).absolute(samples);
    counter!("cpn_training_epochs_total", "run" => run()).absolute(epoch);
    gauge!("cpn_training_steps_expected", "run" => run()).set(steps as f64);
    gauge!("cpn_training_loss", "run" => run()).set(loss);
    gauge!("cpn_training_learning_rate", "run" => run()).set(learning_rate);
    gauge!("cpn_training_gradient_norm", "run" => run()).set(gradient_norm);
    gauge!("cpn_training_samples_per_second", "run" => run()).set(samples_per_second);
}
