//! Compiles the protobuf definitions, without a system protoc.

use prost::Message as _;
use std::{env, error::Error, fs, path::Path};

fn main() -> Result<(), Box<dyn Error>> {
    let manifest_dir = env::var("CARGO_MANIFEST_DIR")?;
    let roots = ["../../proto", "proto"].map(|root| Path::new(&manifest_dir).join(root));

    let mut files = Vec::new();
    for (root, folder) in roots.iter().zip(["cpn/v1", "inference"]) {
        println!("cargo::rerun-if-changed={}", root.display());
        for entry in fs::read_dir(root.join(folder))? {
            files.push(entry?.path());
        }
    }
    files.sort();
    let descriptors = protox::compile(&files, &roots)?;
    fs::write(Path::new(&env::var("OUT_DIR")?).join("descriptors.bin"), descriptors.encode_to_vec())?;

    let mut config = tonic_prost_build::Config::new();
    config.enable_type_names();
    // An input tensor may be two bytes on the wire, so that a request has half a million: each is kept small in memory.
    config.btree_map([".inference"]).boxed(".inference.ModelInferRequest.InferInputTensor.contents");
    tonic_prost_build::configure().compile_fds_with_config(descriptors, config)?;
    Ok(())
}
