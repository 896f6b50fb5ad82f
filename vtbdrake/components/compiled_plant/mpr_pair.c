/* The contact of two shapes, see mpr.c, which goes before it.

The text before both defines NAME; for each shape K of 1 and 2: KIND_K, SIZE_K[3], COUNT_K, VERTICES_K[COUNT_K][3],
CENTER_K[3] (m, in its frame), REACH_K: the largest distance from the center (m).

Arguments: for each shape its rotation in the world (3, 3), by columns, and its position (3, m).
Results: the distance (m, below 0 in contact, else above), the normal from shape 1 into shape 2 (3), and the point in the
middle between both surfaces (3, m), in the world. */

int NAME(const double **arg, double **res, long long int *iw, double *w, int mem) {
    (void)iw, (void)w, (void)mem;
    static const double none[9] = {0.0};
    const double *in[4];
    for (int i = 0; i < 4; ++i) in[i] = arg[i] ? arg[i] : none;
    Shape shapes[2] = {{KIND_1, COUNT_1, SIZE_1, VERTICES_1, CENTER_1, in[0], in[1]},
                       {KIND_2, COUNT_2, SIZE_2, VERTICES_2, CENTER_2, in[2], in[3]}};
    double centers[2][3], apart[3], normal[3] = {0.0, 0.0, 1.0}, point[3] = {0.0, 0.0, 0.0}, depth = -1.0;
    for (int k = 0; k < 2; ++k) into_world(shapes + k, shapes[k].center, centers[k]);
    subtract(centers[0], centers[1], apart);
    if (!(dot(apart, apart) > (REACH_1 + REACH_2) * (REACH_1 + REACH_2))) depth = penetration(shapes, normal, point);
    if (depth < 0.0) normal[0] = normal[1] = 0.0, normal[2] = 1.0;
    if (res[0]) *res[0] = -depth;
    if (res[1]) memcpy(res[1], normal, sizeof normal);
    if (res[2]) memcpy(res[2], point, sizeof point);
    return 0;
}
