# Makes measurements.csv of one material of a table of real fabrics (docs/real_fabrics.md):
#
#   awk -v source=nbrdf_merl -v material=white-fabric -f to_measurements.awk real_fabrics_16.csv > measurements.csv
#
# The table has one row per configuration: light_angle, camera_angle (polar, degrees), phi_o (azimuth of the camera from the
# light's), fabric_rot, and R, G, B: the BRDF in 1/sr. The fabrics are isotropic, so the camera goes to azimuth 0 and the
# light to phi_o, as in plans/khungurn16.toml; goniofit converts from 1/sr itself, by the comment on the first line.
#
# Standard errors are a choice, the table has none: relative (default 0.02) and floor (default 0.0002 per sr), in quadrature.
# Rows with light and camera both at 80 degrees are left out: there the table is extrapolation.
BEGIN {
    FS = OFS = ","
    if (relative == "") relative = 0.02
    if (floor == "") floor = 0.0002
}
function se(f) { return sprintf("%.6g", sqrt((relative * f) ^ 2 + floor ^ 2)) }
FNR == 1 { for (i = 1; i <= NF; i++) at[$i] = i; next }
$at["source"] != source || $at["material"] != material { next }
$at["light_angle"] == 80 && $at["camera_angle"] == 80 { next }
{
    if (!rows++) {
        print "# quantity: brdf, unit 1/sr"
        print "config,light_theta_deg,light_phi_deg,camera_theta_deg,camera_phi_deg,rotation_deg," \
            "r,g,b,r_se,g_se,b_se"
    }
    r = $at["R"]; g = $at["G"]; b = $at["B"]
    print $at["config"] + 1, $at["light_angle"], $at["phi_o"], $at["camera_angle"], 0, $at["fabric_rot"], \
        r, g, b, se(r), se(g), se(b)
}
END {
    if (!rows) {
        print "no rows of source '" source "', material '" material "'" > "/dev/stderr"
        exit 2
    }
}
