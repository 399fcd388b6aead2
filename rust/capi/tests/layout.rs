//! Checks with the C compiler that the structs of `include/sewfast.h` have the memory layout that the library reads:
//! size and offset of every field.
//!
//! Rust's layout is written as assertions after the header and compiled: a field that is missing or has another name, size or offset does
//! not compile. Offsets are those of this machine; `#[repr(C)]` gives the same rule on every target.

use std::fmt::Write;
use std::io::Write as _;
use std::mem::{offset_of, size_of, size_of_val};
use std::process::{Command, Stdio};

use sewfast_capi::device::{CAPACITY, CChannel, CIdentity, CLimits, CMeasurement, COutput};
use sewfast_capi::pid::{CBiquad, CLevel, CPoint, CSettings};

/// Size of a struct, and size and offset of its fields, as assertions in C. A new field in Rust must be named here,
/// because the pattern has no `..`.
macro_rules! layout {
    ($text:expr, $c:literal, $rust:ident { $($field:ident),+ }) => {
        let text: &mut String = $text;
        writeln!(text, "_Static_assert(sizeof({}) == {}, \"size of {}\");", $c, size_of::<$rust>(), $c).unwrap();
        let each = |value: &$rust| {
            let $rust { $($field),+ } = value;
            [$((stringify!($field), offset_of!($rust, $field), size_of_val($field))),+]
        };
        // SAFETY: numbers, pointers and bools, for all of which zeros are valid.
        for (field, offset, size) in each(&unsafe { std::mem::zeroed() }) {
            writeln!(text, "_Static_assert(offsetof({}, {field}) == {offset}, \"place of {field}\");", $c).unwrap();
            writeln!(text, "_Static_assert(sizeof((({} *)0)->{field}) == {size}, \"size of {field}\");", $c).unwrap();
        }
    };
}

fn assertions() -> String {
    let mut text = String::from("#include <stddef.h>\n#include \"sewfast.h\"\n");
    let t = &mut text;
    layout!(
        t,
        "sewfast_channel",
        CChannel {
            encoding,
            source,
            further,
            steps_per_unit,
            name,
            unit
        }
    );
    layout!(
        t,
        "sewfast_limits",
        CLimits {
            volt,
            speed,
            acceleration,
            current
        }
    );
    layout!(
        t,
        "sewfast_identity",
        CIdentity {
            boot_id,
            entropy,
            name,
            firmware,
            period,
            counts_per_rev,
            capabilities,
            ceilings,
            channels,
            channel_count,
            travel_low,
            travel_high
        }
    );
    layout!(
        t,
        "sewfast_measurement",
        CMeasurement {
            counts,
            current,
            further,
            further_count
        }
    );
    layout!(t, "sewfast_output", COutput { u, enabled });
    layout!(t, "sewfast_pid_point", CPoint { speed, kp, ti, td });
    layout!(t, "sewfast_pid_biquad", CBiquad { c0, c1, a1, a2 });
    layout!(t, "sewfast_pid_level", CLevel { y, u });
    layout!(
        t,
        "sewfast_pid_settings",
        CSettings {
            kp,
            ti,
            td,
            alpha,
            beta,
            n,
            tt,
            u_min,
            u_max,
            slew,
            ts,
            filter_time,
            filter_samples,
            observer_time,
            r_rate,
            schedule_count,
            schedule,
            biquad_count,
            biquads,
            level_count,
            tap_count,
            preview,
            late,
            levels,
            taps
        }
    );
    writeln!(
        text,
        "_Static_assert(SEWFAST_CAPACITY == {CAPACITY}, \"capacity\");"
    )
    .unwrap();
    text
}

/// The compiler's messages about a file; `None` if there is no compiler.
fn complaints(source: &str) -> Option<String> {
    let compiler = std::env::var("CC").unwrap_or_else(|_| "cc".to_owned());
    let include = concat!(env!("CARGO_MANIFEST_DIR"), "/include");
    let mut child = Command::new(compiler)
        .args([
            "-std=c11",
            "-Wall",
            "-Werror",
            "-fsyntax-only",
            "-x",
            "c",
            "-I",
            include,
            "-",
        ])
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .ok()?;
    child
        .stdin
        .take()
        .unwrap()
        .write_all(source.as_bytes())
        .unwrap();
    let done = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.success(), said.is_empty(), "{said}");
    Some(said)
}

#[test]
fn the_header_has_the_structs_of_the_library() {
    let source = assertions();
    let Some(said) = complaints(&source) else {
        eprintln!("no C compiler: the header's structs are not compared");
        return;
    };
    assert_eq!(said, "", "the header and the library differ; change both");
    // and a difference is detected
    for (one, other) in [
        ("(sewfast_limits) == 16", "(sewfast_limits) == 20"),
        ("_pid_settings, beta) == 16", "_pid_settings, beta) == 12"),
    ] {
        assert!(source.contains(one), "{source}");
        let wrong = complaints(&source.replacen(one, other, 1)).unwrap();
        assert!(
            wrong.contains("static assertion failed") || wrong.contains("static_assert"),
            "{wrong}"
        );
    }
}
