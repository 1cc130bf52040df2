//! The planner of each trial.

use crate::presence::Service;
use std::collections::{BTreeMap, BTreeSet};

/// Trials by planner.
#[derive(Debug, Default)]
pub(crate) struct Planners {
    /// Trials under way.
    running: BTreeMap<String, usize>,
    /// Planners that let down a trial after the last that came to its end. One that answers at once that it does not keep
    /// the checkpoint any more would otherwise always have the fewest trials, and get them all.
    suspects: BTreeSet<String>,
}

impl Planners {
    /// The planner for one more trial, of those alive: the one with the fewest under way, suspects last.
    pub(crate) fn assign(&mut self, alive: &BTreeSet<String>) -> Option<String> {
        // Whoever comes back may have been mended.
        self.suspects.retain(|suspect| alive.contains(suspect));
        let load = |name: &&String| (self.suspects.contains(*name), self.running.get(*name).copied().unwrap_or(0));
        let planner = alive.iter().min_by_key(load)?.clone();
        *self.running.entry(planner.clone()).or_default() += 1;
        Some(planner)
    }

    /// Takes a trial off a planner.
    pub(crate) fn release(&mut self, planner: &str) {
        if let Some(running) = self.running.get_mut(planner) {
            *running = running.saturating_sub(1);
        }
    }

    /// Remembers that a service let a trial down.
    pub(crate) fn suspect(&mut self, service: &Service) {
        if let Service::Planner(name) = service {
            self.suspects.insert(name.clone());
        }
    }

    /// Remembers that a trial with a planner came to its end.
    pub(crate) fn clear(&mut self, planner: &str) {
        self.suspects.remove(planner);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alive(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(ToString::to_string).collect()
    }

    fn assign(planners: &mut Planners, names: &[&str]) -> String {
        planners.assign(&alive(names)).unwrap_or_default()
    }

    #[test]
    fn trials_are_spread_over_the_planners_that_are_alive() {
        let mut planners = Planners::default();
        let both = ["a", "b"];
        assert_eq!(planners.assign(&alive(&[])), None);
        assert_eq!([0; 4].map(|_| assign(&mut planners, &both)), ["a", "b", "a", "b"]);
        planners.release("b");
        assert_eq!(assign(&mut planners, &both), "b");
        // All go to the other while one is away, and to that one when it is back.
        assert_eq!([0; 2].map(|_| assign(&mut planners, &["b"])), ["b", "b"]);
        assert_eq!([0; 3].map(|_| assign(&mut planners, &both)), ["a", "a", "a"]);
    }

    #[test]
    fn a_planner_that_lets_trials_down_gets_none_while_another_is_alive() {
        let mut planners = Planners::default();
        let both = ["a", "b"];
        assert_eq!(assign(&mut planners, &both), "a");
        planners.release("a");
        planners.suspect(&Service::Worker("a".into()));
        assert_eq!(assign(&mut planners, &both), "a");
        planners.release("a");
        planners.suspect(&Service::Planner("a".into()));
        assert_eq!([0; 2].map(|_| assign(&mut planners, &both)), ["b", "b"]);
        // Rather that one than none; a trial that comes to its end clears it.
        assert_eq!(assign(&mut planners, &["a"]), "a");
        planners.release("a");
        planners.clear("a");
        assert_eq!(assign(&mut planners, &both), "a");
        // And so does leaving.
        planners.suspect(&Service::Planner("a".into()));
        assert_eq!([&both[..], &both[1..]].map(|alive| assign(&mut planners, alive)), ["b", "b"]);
        assert_eq!(assign(&mut planners, &both), "a");
    }
}
