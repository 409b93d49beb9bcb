#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]
mod toy;
use goniofit::render::relative_error_weight;
use toy::*;
#[test]
fn oracle() {
    for values in [&GABARDINE, &INSIDE] {
        let toy = Toy::default();
        let t = Toy::truth(values);
        // J in u ~ ln theta; P via normal equations with nalgebra-free Gauss
        let p = 9;
        let mut rows = vec![]; // (config, w^.5 J row, w^.5 mean)
        for i in 0..16 {
            let m: Vec<_> = (0..3).map(|c| toy.exact(t.values(), i, c)).collect();
            let w = relative_error_weight([m[0].0, m[1].0, m[2].0], 0.02).sqrt();
            for c in 0..3 {
                rows.push((
                    i,
                    m[c].1
                        .iter()
                        .zip(t.values())
                        .map(|(d, v)| w * d * v)
                        .collect::<Vec<_>>(),
                    w * m[c].0,
                ));
            }
        }
        let mut h = vec![vec![0.0; p]; p];
        for (_, j, _) in &rows {
            for a in 0..p {
                for b in 0..p {
                    h[a][b] += j[a] * j[b];
                }
            }
        }
        let inv = invert(&h);
        // influence matrix P = J H^-1 J'
        let n = 48;
        let pm: Vec<Vec<f64>> = (0..n)
            .map(|m| {
                (0..n)
                    .map(|k| {
                        (0..p)
                            .map(|a| {
                                (0..p)
                                    .map(|b| rows[m].1[a] * inv[a][b] * rows[k].1[b])
                                    .sum::<f64>()
                            })
                            .sum()
                    })
                    .collect()
            })
            .collect();
        // trace of P S P with S block: fully correlated within config, sd = mean*path_sd
        let mut a = vec![0.0; 16];
        for i in 0..16 {
            let mut t = 0.0;
            for c in 0..3 {
                for d in 0..3 {
                    t += pm[3 * i + c][3 * i + d] * rows[3 * i + c].2 * rows[3 * i + d].2;
                }
            }
            a[i] = t * toy.path_sd[i].powi(2);
        }
        let s: f64 = a.iter().map(|x| x.max(0.0).sqrt()).sum();
        let eq: f64 = a.iter().sum::<f64>() * 16.0;
        println!(
            "{values:?}\n neyman rms at 1.5M {:.3} %, equal {:.3} %",
            100.0 * (s * s / 48.0 / 1.5e6).sqrt(),
            100.0 * (eq / 48.0 / 1.5e6).sqrt()
        );
        println!(
            "leverage {:?}",
            (0..16)
                .map(|i| (0..3).map(|c| pm[3 * i + c][3 * i + c]).sum::<f64>())
                .map(|x| (x * 100.).round() / 100.)
                .collect::<Vec<_>>()
        );
        println!(
            "share {:?}",
            a.iter()
                .map(|x| (x.max(0.0).sqrt() / s * 1000.).round() / 10.)
                .collect::<Vec<_>>()
        );
        println!(
            "means {:?}",
            (0..48)
                .map(|m| (toy.mean(t.values(), m / 3, m % 3) * 1000.).round() / 1000.)
                .collect::<Vec<_>>()
        );
        println!(
            "sd per parameter(ln) at 1%: {:?}",
            (0..9).map(|j| 0.01 * inv[j][j].sqrt()).collect::<Vec<_>>()
        );
    }
}
fn invert(a: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let n = a.len();
    let mut m: Vec<Vec<f64>> = a
        .iter()
        .enumerate()
        .map(|(i, r)| {
            let mut r = r.clone();
            r.extend((0..n).map(|j| if i == j { 1.0 } else { 0.0 }));
            r
        })
        .collect();
    for i in 0..n {
        let piv = (i..n)
            .max_by(|&x, &y| m[x][i].abs().total_cmp(&m[y][i].abs()))
            .unwrap();
        m.swap(i, piv);
        let d = m[i][i];
        for x in &mut m[i] {
            *x /= d;
        }
        let ri = m[i].clone();
        for k in 0..n {
            if k != i {
                let f = m[k][i];
                for (x, y) in m[k].iter_mut().zip(&ri) {
                    *x -= f * y;
                }
            }
        }
    }
    m.into_iter().map(|r| r[n..].to_vec()).collect()
}
