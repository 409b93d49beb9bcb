//! Which instructions the processor has, asked once; the same code compiled for each.

/// Work whose `run`, and all it calls, is `#[inline(always)]`, so that it is compiled for the caller's instructions.
pub(super) trait Task {
    type Out;
    /// `FUSED`: whether multiplication and addition are fused (in hardware, on this path).
    fn run<const FUSED: bool>(self) -> Self::Out;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Processor {
    /// What the program was compiled for.
    Baseline,
    /// AVX2 with FMA.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// The same width with the masks and the 32 registers of AVX-512: about a tenth faster.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Processor {
    pub(super) fn detect() -> Self {
        *Self::all().last().unwrap_or(&Self::Baseline)
    }

    /// All that this machine can run, slowest first.
    pub(super) fn all() -> Vec<Self> {
        let mut all = vec![Self::Baseline];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                all.push(Self::Avx2);
                if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
                    all.push(Self::Avx512);
                }
            }
        }
        all
    }

    /// Runs `task` with this processor's instructions.
    #[inline(always)]
    #[allow(
        unsafe_code,
        reason = "calls functions compiled for instructions that `all` found on this machine; twice as fast as the baseline"
    )]
    pub(super) fn run<T: Task>(self, task: T) -> T::Out {
        match self {
            Self::Baseline => baseline(task),
            // SAFETY: `detect` and `all` return this only where the instructions exist.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { avx2(task) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: as above.
            Self::Avx512 => unsafe { avx512(task) },
        }
    }
}

fn baseline<T: Task>(task: T) -> T::Out {
    task.run::<{ cfg!(any(target_feature = "fma", target_arch = "aarch64")) }>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<T: Task>(task: T) -> T::Out {
    task.run::<true>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512vl")]
fn avx512<T: Task>(task: T) -> T::Out {
    task.run::<true>()
}
