//! (room)

pub mod swatch;
