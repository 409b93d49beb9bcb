#![no_main]

#[path = "../harness.rs"]
mod harness;

libfuzzer_sys::fuzz_target!(init: harness::begin(), |bytes: &[u8]| {
    harness::readers::plan(bytes);
});
