//! Direction of dependencies: services depend on libraries; of the libraries only `recording` and `service-kit` depend on another,
//! `wire`. Within `cpn`, files import each other without cycles, and the engine's levels only lower ones.

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::Command;

/// Names of the dependencies of each workspace crate, without those of tests.
fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let of = |package: &Value| {
        let all = package["dependencies"].as_array().unwrap().iter();
        all.filter(|dependency| dependency["kind"] != "dev").map(|dependency| text(&dependency["name"])).collect()
    };
    metadata["packages"].as_array().unwrap().iter().map(|package| (text(&package["name"]), of(package))).collect()
}

#[test]
fn each_crate_depends_only_on_permitted_ones() {
    let allowed: BTreeMap<&str, &[&str]> = BTreeMap::from([
        ("cpn", &[][..]),
        ("cpn-torch", &["cpn"]),
        ("engines", &["cpn", "cpn-torch"]),
        ("testing", &["cpn", "signing"]),
        ("wire", &[]),
        ("service-kit", &["wire"]),
        ("recording", &["wire"]),
        ("signing", &[]),
        ("certs", &["service-kit", "wire"]),
        ("planner", &["cpn", "engines", "signing", "wire", "service-kit"]),
        ("trainer", &["cpn", "engines", "recording", "signing", "wire", "service-kit"]),
        ("evaluator", &["recording", "wire", "service-kit"]),
        ("fuzz", &["cpn", "planner", "recording", "signing", "wire"]),
    ]);
    let dependencies = dependencies();
    assert_eq!(
        dependencies.keys().map(String::as_str).collect::<Vec<_>>(),
        allowed.keys().copied().collect::<Vec<_>>()
    );
    for (name, known) in &dependencies {
        let ours: BTreeSet<_> = known.iter().map(String::as_str).filter(|k| allowed.contains_key(k)).collect();
        assert_eq!(ours, allowed[name.as_str()].iter().copied().collect(), "{name}");
    }
}

#[test]
fn cpn_has_no_network_and_wire_no_tensors() {
    let dependencies = dependencies();
    let knows = |name: &str, others: &[&str]| others.iter().any(|other| dependencies[name].contains(*other));
    assert!(!knows("cpn", &["tch", "tokio", "zenoh", "tonic", "prost", "tracing"]));
    assert!(!knows("wire", &["tch", "tokio"]));
    assert!(!knows("signing", &["tch", "tokio", "tracing"]));
    assert!(!knows("recording", &["tch", "tokio", "zenoh"]));
    let with_libtorch: Vec<_> = dependencies.iter().filter(|(_, known)| known.contains("tch")).collect();
    assert!(matches!(with_libtorch[..], [(name, _)] if name == "cpn-torch"), "{with_libtorch:?}");
}

/// Dependency levels of `crates/cpn/src/engine`, from the lowest.
const STOREYS: [&str; 6] = ["simd", "gemm", "layers", "networks", "planning", "training"];

/// Module, as the segments of its path; empty for the crate itself.
type Module = Vec<String>;

/// Sources of a folder by module, without comments and unit tests.
fn sources(folder: &Path, module: &[String], modules: &mut BTreeMap<Module, String>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        if path.is_dir() {
            sources(&path, &[module, &[name]].concat(), modules);
        } else {
            let source = fs::read_to_string(&path).unwrap();
            let code = source.split("#[cfg(test)]\nmod").next().unwrap().lines();
            let code = code.map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n");
            let is_root = name == "lib" || name == "mod";
            modules.insert(if is_root { module.to_vec() } else { [module, &[name]].concat() }, code);
        }
    }
}

/// Expands `a::{b, c::{d, self}}` to `a::b`, `a::c::d` and `a::c`.
fn expand(tree: &str) -> Vec<String> {
    let Some((prefix, group)) = tree.split_once('{') else { return vec![tree.trim().replace("::self", "")] };
    let group = group.trim_end().strip_suffix('}').unwrap();
    let (mut depth, mut items) = (0, vec![String::new()]);
    for c in group.chars() {
        depth += i32::from(c == '{') - i32::from(c == '}');
        match c {
            ',' if depth == 0 => items.push(String::new()),
            c => items.last_mut().unwrap().push(c),
        }
    }
    let items = items.iter().filter(|item| !item.trim().is_empty());
    items.flat_map(|item| expand(&format!("{}{}", prefix.trim(), item.trim()))).collect()
}

/// Paths that code imports, by `use` or in place.
fn paths(code: &str) -> Vec<String> {
    let (mut paths, mut rest) = (Vec::new(), String::new());
    for (i, part) in code.split("use ").enumerate() {
        match part.split_once(';') {
            Some((tree, behind)) if i > 0 => {
                paths.extend(expand(tree));
                rest.push_str(behind);
            }
            _ => rest.push_str(part),
        }
    }
    let words = rest.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':'));
    paths.extend(words.filter(|word| word.starts_with("crate::") || word.starts_with("super::")).map(str::to_owned));
    paths
}

/// Resolves a path, as seen from a module, to its module; none for other crates.
fn resolve(path: &str, from: &Module, modules: &BTreeMap<Module, String>) -> Option<Module> {
    let mut segments: Vec<_> = path.split("::").map(|segment| segment.split(' ').next().unwrap().to_owned()).collect();
    let mut base = from.clone();
    match segments[0].as_str() {
        "crate" => base.clear(),
        "super" | "self" => {}
        child if modules.contains_key(&[&from[..], &[child.to_owned()]].concat()) => {
            segments.insert(0, "self".to_owned())
        }
        _ => return None,
    }
    for segment in segments {
        match segment.as_str() {
            "crate" | "self" => {}
            "super" => drop(base.pop()),
            name if modules.contains_key(&[&base[..], &[name.to_owned()]].concat()) => base.push(name.to_owned()),
            _ => break,
        }
    }
    Some(base)
}

/// Imports between the modules of `crates/cpn/src`.
fn imports() -> BTreeMap<Module, BTreeSet<Module>> {
    let mut modules = BTreeMap::new();
    sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../cpn/src"), &[], &mut modules);
    let of = |(module, code): (&Module, &String)| {
        let all = paths(code).into_iter().filter_map(|path| resolve(&path, module, &modules));
        (module.clone(), all.filter(|imported| imported != module).collect())
    };
    modules.iter().map(of).collect()
}

#[test]
fn imports_within_cpn_have_no_cycles() {
    let mut left = imports();
    assert!(left[&vec!["checkpoint".to_owned()]].contains(&vec!["model".to_owned()]), "imports are found: {left:?}");
    loop {
        // Topological order: a file is done once all of its imports are.
        let placed: Vec<_> = left.iter().filter(|(_, known)| known.is_empty()).map(|(file, _)| file.clone()).collect();
        if placed.is_empty() {
            break;
        }
        for file in placed {
            left.remove(&file);
            left.values_mut().for_each(|known| known.retain(|other| *other != file));
        }
    }
    assert!(left.is_empty(), "circles of imports, or what lies above one: {left:#?}");
}

#[test]
fn levels_of_the_engine_import_only_lower_ones() {
    let storey = |module: &Module| {
        let name = module.get(1).filter(|_| module[0] == "engine")?;
        Some(STOREYS.iter().position(|storey| storey == name).unwrap_or_else(|| panic!("no storey: {module:?}")))
    };
    let imports = imports();
    let above = STOREYS.map(|name| vec!["engine".to_owned(), name.to_owned()]);
    assert!(above.iter().all(|storey| imports.contains_key(storey)), "each storey is there");
    for (module, imported) in &imports {
        for other in imported {
            if let (Some(ours), Some(theirs)) = (storey(module), storey(other)) {
                assert!(theirs <= ours, "{module:?} imports {other:?}");
            }
        }
    }
}

#[test]
fn groups_of_imports_are_expanded() {
    assert_eq!(expand("a::{b, c::{d, self}, e as f}"), ["a::b", "a::c::d", "a::c", "a::e as f"]);
    assert_eq!(paths("use a::{b};\nfn f() { crate::c::d(super::e) }"), ["a::b", "crate::c::d", "super::e"]);
}
