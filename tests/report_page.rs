//! The page of a fit is one well-formed file that loads nothing, escapes what it shows and says what must be said; and
//! fit.json survives the round trip.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod markup;
mod toy;

use goniofit::base::Unwatched;
use goniofit::fit::{Budget, FitResult, Options, fit};
use goniofit::report::{Picture, Provenance, Section, Table, page};
use markup::check_nesting;
use toy::{INSIDE, Toy};

fn result() -> FitResult {
    let toy = Toy {
        beta_r_acts: false,
        ..Toy::default()
    };
    let truth = Toy::truth(&INSIDE);
    let budget = Budget {
        paths: Some(500_000),
        ..Budget::default()
    };
    let measurements = toy.measure(&truth, 0.02, 1);
    let mut result = fit(&toy, &measurements, &Options::new(1, budget), &Unwatched).unwrap();
    result.fabric = "fabrics/<script>alert('x')</script>&\"co\".toml".to_owned();
    result.command = "goniofit fit --out 'a<b>'".to_owned();
    result.synthetic = Some(true);
    result
        .add_truth(truth.to_json(), toy.means(&truth))
        .unwrap();
    result
}

fn provenance() -> Provenance {
    let pixels: Vec<u8> = (0..4 * 3 * 3).collect();
    Provenance {
        title: None,
        facts: vec![("rig".to_owned(), "bench <1>".to_owned())],
        sections: vec![Section {
            title: "Frames & more".to_owned(),
            paragraphs: vec!["as seen by the <camera>".to_owned()],
            table: Some(Table {
                head: vec!["a".to_owned(), "b".to_owned()],
                rows: vec![vec!["1 < 2".to_owned(), "3".to_owned()]],
            }),
            pictures: vec![Picture::from_rgb("frame \"1\"", 4, 3, &pixels).unwrap()],
        }],
    }
}

#[test]
fn the_page_is_well_formed_and_loads_nothing() {
    let html = page(&result(), &provenance());
    assert!(check_nesting(&html) > 300);
    // The only addresses are the fragments of the page itself and embedded pictures.
    for forbidden in [
        "http:", "https:", "src=\"/", "//cdn", "<script", "<link", "<iframe", "@import", "url(",
        "NaN", "inf ",
    ] {
        assert!(!html.contains(forbidden), "{forbidden}");
    }
    assert_eq!(html.matches("src=").count(), 1);
    assert!(html.contains("src=\"data:image/png;base64,iVBORw0KGgo"));
    assert!(html.contains("name=\"viewport\"") && html.contains("prefers-color-scheme:dark"));
    assert!(html.is_ascii() || html.contains("charset=\"utf-8\""));
}

#[test]
fn text_is_escaped_wherever_it_comes_from() {
    let html = page(&result(), &provenance());
    assert!(
        html.contains("&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt;&amp;&quot;co&quot;.toml")
    );
    for text in [
        "&lt;camera&gt;",
        "1 &lt; 2",
        "bench &lt;1&gt;",
        "Frames &amp; more",
        "frame &quot;1&quot;",
        "a&lt;b&gt;",
    ] {
        assert!(html.contains(text), "{text}");
    }
}

#[test]
fn the_page_says_what_must_be_said() {
    let result = result();
    let html = page(&result, &Provenance::default());
    assert!(html.contains("SYNTHETIC"));
    assert!(html.contains("beta_r is not determined by these configurations: "));
    for heading in [
        "Measured and rendered",
        "Parameters between their bounds",
        "Residual by configuration",
        "Convergence",
        "Correlations",
        "How this was made",
    ] {
        assert!(html.contains(heading), "{heading}");
    }
    // One mark per number and one legend mark per channel.
    assert_eq!(html.matches("class=\"m0\"").count(), 16 + 1);
    assert_eq!(html.matches("class=\"m2\"").count(), 16 + 1);
    // A photograph's fit is not called synthetic, and shows no truth.
    let mut real = result;
    real.synthetic = Some(false);
    real.truth = None;
    let html = page(&real, &Provenance::default());
    assert!(
        !html.contains("SYNTHETIC") && !html.contains(">truth<") && !html.contains("noise-free")
    );
}

#[test]
fn a_page_of_odd_numbers_is_still_a_page() {
    let mut result = result();
    for c in &mut result.configs {
        c.measured = [Some(0.0); 3];
        c.rendered = [0.0, -0.001, 0.0];
        c.relative_residual = [Some(0.0); 3];
    }
    result.history.clear();
    result.objective.weighted_rms_percent = 0.0;
    result.objective.fit_monte_carlo_percent = 0.0;
    let html = page(&result, &Provenance::default());
    check_nesting(&html);
    assert!(!html.contains("NaN") && !html.contains("inf\""));
}

#[test]
fn fit_json_survives_the_round_trip_and_is_never_overwritten() {
    let result = result();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("fit.json");
    result.write(&path, false).unwrap();
    assert_eq!(FitResult::read(&path).unwrap(), result);
    let text = std::fs::read_to_string(&path).unwrap();
    let error = result.write(&path, false).unwrap_err().report();
    assert!(
        error.contains("exists already") && error.contains("--force"),
        "{error}"
    );
    assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
    result.write(&path, true).unwrap();

    // The keys scripts read.
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    for key in [
        "parameters",
        "model",
        "fabric",
        "configs",
        "objective",
        "uncertainty",
        "not_determined",
        "converged",
        "reason",
        "seed",
        "versions",
        "time",
        "history",
        "command",
        "synthetic",
        "truth",
    ] {
        assert!(json.get(key).is_some(), "{key}");
    }
    let first = &json["configs"][0];
    for key in [
        "config",
        "measured",
        "measured_se",
        "rendered",
        "rendered_se",
        "residual",
        "light_theta_deg",
    ] {
        assert!(first.get(key).is_some(), "{key}: {first}");
    }
    assert!(json["objective"]["weighted_rms_percent"].is_f64());
    assert!(json["parameters"]["beta_tt_deg"].is_f64() && json["parameters"]["c_r"].is_array());

    // Another file is refused with the reason.
    std::fs::write(&path, "{}").unwrap();
    assert!(
        FitResult::read(&path)
            .unwrap_err()
            .report()
            .contains("is not a fit.json")
    );
    std::fs::write(&path, text.replace("goniofit-fit-1", "goniofit-fit-9")).unwrap();
    assert!(
        FitResult::read(&path)
            .unwrap_err()
            .report()
            .contains("goniofit-fit-9")
    );
}

#[test]
fn pictures_check_their_size() {
    assert!(Picture::from_rgb("x", 4, 3, &[0; 35]).is_err());
    assert!(Picture::from_rgb("x", 0, 3, &[]).is_err());
}
