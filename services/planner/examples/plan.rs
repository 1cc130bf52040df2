//! Plan request over zenoh, towards a goal image.
//!
//! cargo run --release -p planner --example plan -- examples/goal.png examples/frame.png

use anyhow::Context;
use service_kit::SessionConfig;
use std::time::Duration;
use wire::planner::{Goal, PlanRequest, PlanResponse};
use wire::{Image, key, query};

fn read(path: &str) -> anyhow::Result<Image> {
    let image = image::open(path).with_context(|| path.to_owned())?.to_rgb8();
    Ok(Image::new(image.height(), image.width(), image.into_raw())?)
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let goal = read(&arguments.next().context("usage: plan GOAL.png FRAME.png [ENDPOINT]")?)?;
    let observation = read(&arguments.next().context("usage: plan GOAL.png FRAME.png [ENDPOINT]")?)?;
    let endpoint = arguments.next().unwrap_or_else(|| "tcp/127.0.0.1:7447".into());

    let session = service_kit::session::open(&SessionConfig { connect: vec![endpoint], ..Default::default() }).await?;
    let request = PlanRequest::new("cpn", Goal::Image(goal), observation.into());
    let key = key::planner_plan("planner")?;
    let plan: PlanResponse = query::call(&session, &key, request, Duration::from_secs(10)).await?;
    println!("apply {:?} of {} planned actions", plan.first_action, plan.actions.len());
    println!("inner loss {:?} latent distance {:?}", plan.inner_losses, plan.latent_distance);
    Ok(())
}
