//! Directions and frames, lobes and special functions, random streams, statistics.
//!
//! Pure numbers: knows neither cloth nor files. Angles are radians, everything is `f64`.

pub mod direction;
pub mod kronrod;
pub mod quadrature;
pub mod random;
pub mod special;
pub mod statistics;

pub use direction::{Frame, PolarDirection};
pub use quadrature::GaussLegendre;
pub use random::Random;
