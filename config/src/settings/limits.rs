//! What a number may be.

use std::ops::Bound;

/// What a number may be; never NaN, never infinite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    low: Bound<f64>,
    high: Bound<f64>,
}

impl Limits {
    /// Any finite number.
    pub const ANY: Self = Self { low: Bound::Unbounded, high: Bound::Unbounded };

    /// `low` to `high`, both included.
    pub const fn within(low: f64, high: f64) -> Self {
        Self { low: Bound::Included(low), high: Bound::Included(high) }
    }

    /// `low` or more.
    pub const fn at_least(low: f64) -> Self {
        Self { low: Bound::Included(low), high: Bound::Unbounded }
    }

    /// More than `low`.
    pub const fn above(low: f64) -> Self {
        Self { low: Bound::Excluded(low), high: Bound::Unbounded }
    }

    /// And `high` at most.
    pub const fn up_to(self, high: f64) -> Self {
        Self { low: self.low, high: Bound::Included(high) }
    }

    /// And less than `high`.
    pub const fn below(self, high: f64) -> Self {
        Self { low: self.low, high: Bound::Excluded(high) }
    }

    pub(super) fn hold(&self, value: f64) -> bool {
        value.is_finite() && std::ops::RangeBounds::contains(&(self.low, self.high), &value)
    }

    /// Limits for numbers of 32 bits: 0.1 is another number there.
    pub(super) fn single(&self) -> Self {
        let round = |limit: Bound<f64>| limit.map(|l| f64::from(l as f32));
        Self { low: round(self.low), high: round(self.high) }
    }
}

impl std::fmt::Display for Limits {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        use Bound::{Excluded, Included, Unbounded};
        match (self.low, self.high) {
            (Unbounded, Unbounded) => write!(f, "a finite number"),
            (Included(low), Included(high)) => write!(f, "{low} to {high}"),
            (Included(low), Unbounded) => write!(f, "{low} or more"),
            (Excluded(low), Unbounded) => write!(f, "above {low}"),
            (Included(low), Excluded(high)) => write!(f, "{low} or more and below {high}"),
            (Excluded(low), Included(high)) => write!(f, "above {low} and at most {high}"),
            (Excluded(low), Excluded(high)) => write!(f, "above {low} and below {high}"),
            (Unbounded, Included(high)) => write!(f, "at most {high}"),
            (Unbounded, Excluded(high)) => write!(f, "below {high}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::Value;

    #[test]
    fn limits_hold_what_they_say_and_never_nan() {
        let l = Limits::above(0.0).up_to(1.0);
        assert!(l.hold(1.0) && l.hold(1e-9) && !l.hold(0.0) && !l.hold(1.1) && !l.hold(f64::NAN));
        assert!(!Limits::ANY.hold(f64::INFINITY) && !Limits::at_least(0.0).hold(f64::NAN));
        assert!(Limits::at_least(0.0).below(0.5).hold(0.0) && !Limits::at_least(0.0).below(0.5).hold(0.5));
        // 0.1 in 32 bits is a little more than in 64.
        assert!(Value::check(&0.1_f32, &Limits::within(0.0, 0.1)).is_ok());
        assert_eq!(Limits::within(16.0, 8192.0).to_string(), "16 to 8192");
    }
}
