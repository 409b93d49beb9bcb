//! The rig file, and whether the plan can be reached with it.

use super::Findings;
use crate::base::{Context, Result};
use crate::rig::RigDescription;
use crate::session::Plan;

pub(super) fn look(rig: &RigDescription, plan: Option<&Plan>, findings: &mut Findings) {
    let motors: usize = rig
        .boards
        .iter()
        .map(|b| rig.motors_of(&b.name).count())
        .sum();
    findings.ok(format!(
        "{}: driven axes: {motors}, boards: {}",
        rig.name,
        rig.boards.len()
    ));
    if let Some(plan) = plan {
        match reach(rig, plan) {
            Ok(()) => findings.ok(format!(
                "plan {}: all {} configurations and the ways between them are inside the limits",
                plan.name,
                plan.configurations.len()
            )),
            Err(error) => findings.fail(&error),
        }
    }
}

/// Every configuration, and the way to it from the one before; the white standard comes first.
fn reach(rig: &RigDescription, plan: &Plan) -> Result<()> {
    let mut from = rig.angles(&rig.white.configuration(0))?;
    for (configuration, to) in plan.configurations.iter().zip(rig.plan_angles(plan)?) {
        rig.path(&from, &to)
            .context(|| format!("the way to configuration {}", configuration.id))?;
        from = to;
    }
    Ok(())
}
