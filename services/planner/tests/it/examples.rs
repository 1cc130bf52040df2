//! Examples: README quotes one verbatim and links the others, and they run.

use crate::common;
use std::path::Path;
use std::process::Command;
use testing::process::free_address;

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

#[test]
fn the_readme_quotes_one_example_and_links_the_others() {
    let read = |file| std::fs::read_to_string(Path::new(ROOT).join(file)).unwrap();
    let readme = read("README.md");
    assert!(readme.contains(&read("examples/plan.py")), "README.md: expected the text of examples/plan.py");
    for file in [
        "examples/closed_loop.py",
        "examples/plan_zenoh.py",
        "examples/plan_grpc.py",
        "examples/plan_openpi.py",
        "examples/plan_triton.py",
        "services/planner/examples/plan.rs",
    ] {
        assert!(
            !read(file).is_empty() && readme.contains(&format!("]({file})")),
            "README.md: expected a link to {file}"
        );
    }
}

/// Runs an example in the examples' environment against a planner.
async fn run(example: &str, endpoint: String) {
    let python = Path::new(ROOT).join("examples/.venv/bin/python");
    let mut command = Command::new(python);
    command.current_dir(ROOT).args([example, "examples/goal.png", "examples/frame.png", &endpoint]);
    let output = tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap();
    let (text, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && text.contains("of 5 planned actions"), "{text}{errors}");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_python_examples_get_plans() {
    let endpoint = format!("tcp/{}", free_address());
    let models_dir = tempfile::tempdir().unwrap();
    let checkpoint = common::checkpoint(cpn::MethodKind::Cpn, 1);
    std::fs::write(models_dir.path().join("cpn.safetensors"), checkpoint).unwrap();
    let config = planner::Config {
        models_dir: models_dir.path().into(),
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        session: service_kit::SessionConfig { listen: vec![endpoint.clone()], ..Default::default() },
        ..planner::Config::default()
    };
    let planner = planner::start(config).await.unwrap();
    let grpc = planner.grpc_address();
    run("examples/plan.py", endpoint.clone()).await;
    run("examples/plan.py", format!("grpc://{grpc}")).await;
    run("examples/plan_zenoh.py", endpoint).await;
    run("examples/plan_grpc.py", grpc.to_string()).await;
    planner.shutdown().await.unwrap();
}
