//! goniofit: from a gonioreflectometer's plan to fiber scattering parameters.
//!
//! The rooms, in order of flow (ARCHITECTURE.md has the map; `tests/floors.rs` guards the imports):
//!
//! ```text
//! plan --> rig --> frames --> measure --> measurements --+
//!                                                        +--> fit --> report
//! fabric (weave | fibers | voxels) --> render <-- scatter +
//! ```

pub mod base;
pub mod math;

pub mod session;

pub mod rig;

pub mod measure;

pub mod fabric;

pub mod scatter;

pub mod render;

pub mod fit;

pub mod report;

pub mod cli;
