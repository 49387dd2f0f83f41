static ut_real ut_max(ut_real a, ut_real b)
{
    return a > b || isnan(a) ? a : b;
}

static ut_real ut_min(ut_real a, ut_real b)
{
    return a < b || isnan(a) ? a : b;
}

static ut_real ut_mod(ut_real remainder, ut_real b)
{
    return (remainder < 0 && b > 0) || (remainder > 0 && b < 0) ? remainder + b : remainder;
}

static ut_real ut_sign(ut_real a)
{
    return (ut_real)((a > 0) - (a < 0));
}
