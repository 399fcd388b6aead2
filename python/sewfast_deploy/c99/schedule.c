    /* speed, Kp, Kp Ts/Ti, Td, one over the distance to the next point; the last point twice */
    static const @_real rows[@ROWS][5] = {
        @TABLE
    };
    const @_real size = y < R(0.0) ? -y : y;
    const @_real *low = rows[0], *high = rows[0];
    @_real share, weight, td, filter;
    @_terms g;
    int i;
    for (i = 0; i < @ROWS - 1; i++) {
        if (size >= rows[i][0]) {
            low = rows[i];
            high = rows[i + 1];
        }
    }
    share = @_limit((size - low[0]) * low[4], R(0.0), R(1.0));
    g.kp = low[1] + share * (high[1] - low[1]);
    g.ki = low[2] + share * (high[2] - low[2]);
    weight = g.kp == R(0.0) ? R(0.0) : share * high[1] / g.kp;
    td = low[3] + weight * (high[3] - low[3]);
    filter = @FILTER;
    g.kd = g.kp * td / (filter + @STEP);
    g.pole = filter / (filter + @STEP);
    return g;
