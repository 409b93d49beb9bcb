//! The order of poses with little travel.

/// An order of poses.
#[derive(Debug, Clone, PartialEq)]
pub struct Tour {
    /// Indices of the poses, in the order to visit them.
    pub order: Vec<usize>,
    /// What it costs, from the start over all poses to the end.
    pub seconds: f64,
    /// No order costs less than this; equal to `seconds` when the order is known to be the best.
    pub lower_bound: f64,
}
