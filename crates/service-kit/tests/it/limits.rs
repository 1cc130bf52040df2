//! `docs/limits.md` against the code: every row cites its source verbatim, and no bound of messages and services is missing.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
/// Folders whose `MAX_` constants must all be listed.
const BOUNDED: [&str; 5] =
    ["crates/wire/src", "services/certs/src", "services/evaluator/src", "services/planner/src", "services/trainer/src"];
/// Number of cells of a row: bound, value, set by, effect, source.
const COLUMNS: usize = 5;

/// Citation of the code: a file, and `NAME = initialiser` of a constant or other text in it.
type Citation = (String, String);

fn read(file: &str) -> String {
    std::fs::read_to_string(Path::new(ROOT).join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

/// Rows of all tables, without heads.
fn rows(page: &str) -> Vec<&str> {
    let lines: Vec<_> = page.lines().collect();
    let is_rule = |line: &str| line.starts_with("|-");
    let next = lines.iter().skip(1).chain([&""]);
    let rows = lines.iter().zip(next).filter(|(line, next)| line.starts_with('|') && !is_rule(line) && !is_rule(next));
    rows.map(|(line, _)| *line).collect()
}

/// Citations in the last cell of a row: files in backticks, each followed by texts in backticks.
fn citations(row: &str) -> Vec<Citation> {
    let cells: Vec<_> = row.trim_matches('|').split('|').collect();
    assert_eq!(cells.len(), COLUMNS, "expected {COLUMNS} cells: {row}");
    let (mut file, mut citations) = (None, Vec::new());
    for text in cells[COLUMNS - 1].split('`').skip(1).step_by(2) {
        if Path::new(ROOT).join(text).is_file() {
            file = Some(text.to_owned());
        } else {
            let file = file.clone().unwrap_or_else(|| panic!("{text}: expected a file before it: {row}"));
            citations.push((file, text.to_owned()));
        }
    }
    assert!(!citations.is_empty(), "expected a source: {row}");
    citations
}

/// `NAME = initialiser` of the Rust constant declared in a line.
fn declared(line: &str) -> Option<String> {
    let (before, declaration) = line.trim().split_once("const ")?;
    let is_constant = before.is_empty() || before.starts_with("pub");
    let (name, typed) = declaration.strip_suffix(';')?.split_once(": ")?;
    let (_type, initialiser) = typed.split_once(" = ")?;
    is_constant.then(|| format!("{name} = {initialiser}"))
}

/// Whether a file has the citation: a constant with this initialiser, or the text, with runs of blanks collapsed.
fn is_there((file, text): &Citation) -> bool {
    let source = read(file);
    let constant = |c: char| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_';
    match text.split_once(" = ") {
        Some((name, _)) if name.chars().all(constant) && file.ends_with(".rs") => {
            source.lines().any(|line| declared(line).as_ref() == Some(text))
        }
        Some((name, _)) if name.chars().all(constant) => source.lines().any(|line| line == text),
        _ => source.split_whitespace().collect::<Vec<_>>().join(" ").contains(text.as_str()),
    }
}

/// Rust files below a folder.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths.flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] }).collect()
}

#[test]
fn every_row_of_the_limits_cites_the_code_as_it_is() {
    let page = read("docs/limits.md");
    let cited: Vec<_> = rows(&page).into_iter().flat_map(citations).collect();
    let wrong: Vec<_> = cited.iter().filter(|citation| !is_there(citation)).collect();
    assert!(wrong.is_empty(), "docs/limits.md: expected what the code says, got {wrong:#?}");
}

#[test]
fn every_bound_of_messages_and_services_is_among_the_limits() {
    let page = read("docs/limits.md");
    let cited: BTreeSet<_> = rows(&page).into_iter().flat_map(citations).collect();
    for folder in BOUNDED {
        let mut bounds = BTreeSet::new();
        for path in sources(&Path::new(ROOT).join(folder)) {
            let file = path.strip_prefix(ROOT).unwrap().to_string_lossy().into_owned();
            let declared = read(&file).lines().filter_map(declared).collect::<Vec<_>>();
            bounds.extend(declared.into_iter().filter(|c| c.starts_with("MAX_")).map(|bound| (file.clone(), bound)));
        }
        assert!(!bounds.is_empty(), "{folder}: expected bounds, got none");
        let missing: Vec<_> = bounds.difference(&cited).collect();
        assert!(missing.is_empty(), "docs/limits.md: expected a row for each of {missing:#?}");
    }
}
