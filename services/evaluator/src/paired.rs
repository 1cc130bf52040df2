//! Statistics of two arms on the same variations.

use crate::summary::normal_quantile;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use statrs::distribution::{Binomial, DiscreteCDF};

/// Resamples of a bootstrap interval.
const RESAMPLES: usize = 10_000;

/// Variations by the outcomes of two arms.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Solved by both.
    pub both: usize,
    /// Discordant: solved by A only.
    pub a_only: usize,
    /// Discordant: solved by B only.
    pub b_only: usize,
    /// Solved by none.
    pub neither: usize,
}

impl Counts {
    pub(crate) fn of(pairs: impl IntoIterator<Item = (bool, bool)>) -> Self {
        let mut counts = Self::default();
        for pair in pairs {
            *match pair {
                (true, true) => &mut counts.both,
                (true, false) => &mut counts.a_only,
                (false, true) => &mut counts.b_only,
                (false, false) => &mut counts.neither,
            } += 1;
        }
        counts
    }

    fn pairs(self) -> usize {
        self.both + self.a_only + self.b_only + self.neither
    }
}

/// p of the exact McNemar test (McNemar, 1947), two-sided: twice the binomial probability of at most the smaller number of
/// discordant pairs, if each is as likely in either direction.
pub(crate) fn mcnemar(Counts { a_only, b_only, .. }: Counts) -> f64 {
    let discordant = (a_only + b_only) as u64;
    let fair = Binomial::new(0.5, discordant);
    fair.map_or(1.0, |fair| (2.0 * fair.cdf(a_only.min(b_only) as u64)).min(1.0))
}

/// Tango's score interval of the difference of two paired success rates, A - B (Statistics in Medicine 17, 1998), at
/// [`crate::summary::CONFIDENCE`]. There must be pairs.
pub(crate) fn tango(counts: Counts) -> (f64, f64) {
    let (z, estimate) = (normal_quantile(), difference(counts));
    // The score falls as the difference rises.
    let bound = |(mut low, mut high): (f64, f64), score: f64| {
        for _ in 0..60 {
            let middle = f64::midpoint(low, high);
            if tango_score(counts, middle) > score { low = middle } else { high = middle }
        }
        f64::midpoint(low, high)
    };
    (bound((-1.0, estimate), z), bound((estimate, 1.0), -z))
}

fn difference(counts: Counts) -> f64 {
    (counts.a_only as f64 - counts.b_only as f64) / counts.pairs() as f64
}

/// Standardised distance of what was seen from a difference between the rates.
fn tango_score(counts: Counts, delta: f64) -> f64 {
    let (n, a_only, b_only) = (counts.pairs() as f64, counts.a_only as f64, counts.b_only as f64);
    // The greatest likelihood under that difference has this share of pairs solved by B only, the root of a quadratic.
    let linear = -a_only - b_only + (2.0 * n - a_only + b_only) * delta;
    let constant = -b_only * delta * (1.0 - delta);
    let b_share = ((linear * linear - 8.0 * n * constant).max(0.0).sqrt() - linear) / (4.0 * n);

    let variance = n * (2.0 * b_share + delta * (1.0 - delta));
    let distance = a_only - b_only - n * delta;
    if variance > 0.0 { distance / variance.sqrt() } else { distance * f64::INFINITY }
}

/// Outcomes of one task: of each training run on each variation, of which both arms have the same.
#[derive(Debug, Clone)]
pub(crate) struct TaskOutcomes {
    pub(crate) a: RunOutcomes,
    pub(crate) b: RunOutcomes,
}

/// Outcomes of the training runs of one arm at one task.
#[derive(Debug, Clone)]
pub(crate) struct RunOutcomes {
    /// Which of the arm's groups of training runs they are of. The runs of a group are drawn together for all of its tasks.
    pub(crate) group: usize,
    /// Whether each run, `[run][variation]`, solved the task.
    pub(crate) solved: Vec<Vec<bool>>,
}

impl RunOutcomes {
    /// Mean success rate of the runs.
    pub(crate) fn rate(&self) -> f64 {
        let outcomes: Vec<_> = self.solved.iter().flatten().collect();
        outcomes.iter().filter(|solved| ***solved).count() as f64 / outcomes.len() as f64
    }

    /// The same of runs and variations that were drawn.
    fn drawn_rate(&self, runs: &[usize], variations: &[usize]) -> f64 {
        let solved = runs.iter().map(|run| variations.iter().filter(|at| self.solved[*run][**at]).count());
        solved.sum::<usize>() as f64 / (runs.len() * variations.len()) as f64
    }
}

/// Percentile bootstrap interval of the mean over tasks of the difference A - B, at [`crate::summary::CONFIDENCE`]. Tasks are
/// strata, each with the same weight. Drawn with replacement: the variations of each task, the same for both arms; and the training
/// runs of each group, where an arm has several. Always the same for the same outcomes. There must be tasks, with variations.
pub(crate) fn bootstrap(tasks: &[TaskOutcomes]) -> (f64, f64) {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut draw = |n: usize| (0..n).map(|_| rng.random_range(0..n)).collect::<Vec<_>>();
    let runs_by_group = |arm: fn(&TaskOutcomes) -> &RunOutcomes| {
        let mut runs = Vec::new();
        for RunOutcomes { group, solved } in tasks.iter().map(arm) {
            runs.resize(runs.len().max(group + 1), 0);
            runs[*group] = solved.len();
        }
        runs
    };
    let (runs_a, runs_b) = (runs_by_group(|task| &task.a), runs_by_group(|task| &task.b));

    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let drawn_a: Vec<_> = runs_a.iter().map(|runs| draw(*runs)).collect();
            let drawn_b: Vec<_> = runs_b.iter().map(|runs| draw(*runs)).collect();
            let of_task = |TaskOutcomes { a, b }: &TaskOutcomes| {
                let variations = draw(a.solved[0].len());
                a.drawn_rate(&drawn_a[a.group], &variations) - b.drawn_rate(&drawn_b[b.group], &variations)
            };
            tasks.iter().map(of_task).sum::<f64>() / tasks.len() as f64
        })
        .collect();
    means.sort_by(f64::total_cmp);
    let tail = (1.0 - crate::summary::CONFIDENCE) / 2.0;
    let at = |share: f64| means[(share * (RESAMPLES - 1) as f64).round() as usize];
    (at(tail), at(1.0 - tail))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(both: usize, a_only: usize, b_only: usize, neither: usize) -> Counts {
        Counts { both, a_only, b_only, neither }
    }

    /// Expected values: SciPy, `binomtest(min(b, c), b + c).pvalue`; the fourth is the example of Fagerland, Lydersen and Laake
    /// (Statistics in Medicine 33, 2014).
    #[test]
    fn exact_mcnemar_is_the_binomial_test() {
        let cases = [((1, 9), 0.021484375), ((9, 1), 0.021484375), ((0, 0), 1.0), ((1, 7), 0.0703125), ((5, 5), 1.0)];
        for ((a_only, b_only), p) in cases {
            assert!((mcnemar(counts(3, a_only, b_only, 4)) - p).abs() < 1e-12, "{a_only}, {b_only}");
        }
    }

    /// Expected values: Fagerland, Lydersen and Laake (2014), the asymptotic score interval of their example. Where nothing is
    /// discordant, the score equation gives z² / (n + z²); where everything is, in one direction, (n - z²) / (n + z²).
    #[test]
    fn tango_intervals_are_those_of_the_literature() {
        let (low, high) = tango(counts(1, 1, 7, 12));
        assert!((low + 0.517).abs() < 5e-4 && (high + 0.026).abs() < 5e-4, "{low}, {high}");
        let (low, high) = tango(counts(3, 0, 0, 17));
        let z2 = normal_quantile().powi(2);
        assert!((high - z2 / (20.0 + z2)).abs() < 1e-9 && (low + high).abs() < 1e-9, "{low}, {high}");
        // Turned round with the arms, and within the limits.
        let ((low, high), swapped) = (tango(counts(1, 1, 7, 12)), tango(counts(1, 7, 1, 12)));
        assert!((low + swapped.1).abs() < 1e-9 && (high + swapped.0).abs() < 1e-9);
        let (low, high) = tango(counts(0, 8, 0, 0));
        assert!((low - (8.0 - z2) / (8.0 + z2)).abs() < 1e-9 && high == 1.0, "{low}, {high}");
    }

    fn arm(group: usize, solved: &[&[bool]]) -> RunOutcomes {
        RunOutcomes { group, solved: solved.iter().map(|run| run.to_vec()).collect() }
    }

    /// The standard error of a mean of independent pairs is known.
    #[test]
    fn the_bootstrap_of_one_level_has_the_width_of_the_normal_interval() {
        let n = 200;
        let half: Vec<bool> = (0..n).map(|at| at < n / 2).collect();
        let none = vec![false; n];
        let task = TaskOutcomes { a: arm(0, &[&half]), b: arm(0, &[&none]) };
        let (low, high) = bootstrap(std::slice::from_ref(&task));
        let error = normal_quantile() * (0.25 / n as f64).sqrt();
        assert!((low - 0.5 + error).abs() < 0.006 && (high - 0.5 - error).abs() < 0.006, "{low}, {high}");
        // Two strata: half the variance.
        let (low, high) = bootstrap(&[task.clone(), task.clone()]);
        let error = error / 2f64.sqrt();
        assert!((low - 0.5 + error).abs() < 0.006 && (high - 0.5 - error).abs() < 0.006, "{low}, {high}");
        assert_eq!(bootstrap(std::slice::from_ref(&task)), bootstrap(std::slice::from_ref(&task)));
    }

    /// Of two training runs of which one solves everything and one nothing, the interval is everything that may be: variations
    /// tell nothing of it.
    #[test]
    fn the_bootstrap_of_two_levels_draws_training_runs_for_all_their_tasks() {
        let (all, none) = (vec![true; 50], vec![false; 50]);
        let task = |a_group| TaskOutcomes { a: arm(a_group, &[&all, &none]), b: arm(0, &[&none]) };
        assert_eq!(bootstrap(&[task(0)]), (0.0, 1.0));
        // One checkpoint for both tasks: they rise and fall together.
        assert_eq!(bootstrap(&[task(0), task(0)]), (0.0, 1.0));
        // Twenty that were trained on their own average out.
        let tasks: Vec<_> = (0..20).map(task).collect();
        let (low, high) = bootstrap(&tasks);
        assert!(low > 0.3 && high < 0.7, "{low}, {high}");
    }
}
