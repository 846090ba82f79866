// Native alpha blending, as a bound on this machine's speed: 8x8 tiles, forward and backward, C channels, all cores.
// Built and timed by native.py; not part of the package.
#include <math.h>
#include <string.h>
#define P 64
#ifndef C
#define C 6
#endif
#define TS 8
void fwd(const float*par,const float*feat,const int*gi,const int*st,int NT,int TX,float*out,float*Tout){
#pragma omp parallel for schedule(dynamic,16)
 for(int t=0;t<NT;t++){
  float px[P],py[P],T[P],acc[C][P]; memset(acc,0,sizeof acc);
  int tx=t%TX,ty=t/TX;
  for(int p=0;p<P;p++){px[p]=tx*TS+p%TS+.5f;py[p]=ty*TS+p/TS+.5f;T[p]=1;}
  for(int i=st[t];i<st[t+1];i++){
   const float*g=par+6*gi[i];const float*f=feat+C*gi[i];
   float mx=g[0],my=g[1],a=.5f*g[2],b=g[3],c=.5f*g[4],o=g[5]; float w[P];float tm=0;
   #pragma omp simd reduction(max:tm)
   for(int p=0;p<P;p++){float dx=px[p]-mx,dy=py[p]-my; float e=expf(-(a*dx*dx+c*dy*dy+b*dx*dy));
     float al=o*e; al=al>.999f?.999f:al; al=al<1.f/255?0:al; w[p]=T[p]*al; T[p]-=w[p]; tm=T[p]>tm?T[p]:tm;}
   for(int k=0;k<C;k++){float fk=f[k];
     #pragma omp simd
     for(int p=0;p<P;p++)acc[k][p]+=w[p]*fk;}
   if(tm<1e-4f)break;
  }
  memcpy(out+(size_t)t*C*P,acc,sizeof acc); memcpy(Tout+(size_t)t*P,T,sizeof T);
 }
}
void bwd(const float*par,const float*feat,const int*gi,const int*st,int NT,int TX,const float*out,const float*Tf,const float*gout,float*gi_grad){
#pragma omp parallel for schedule(dynamic,16)
 for(int t=0;t<NT;t++){
  float px[P],py[P],T[P],rem[P]; const float*G=gout+(size_t)t*C*P,*O=out+(size_t)t*C*P;
  int tx=t%TX,ty=t/TX;
  for(int p=0;p<P;p++){px[p]=tx*TS+p%TS+.5f;py[p]=ty*TS+p/TS+.5f;T[p]=1;float s=0;for(int k=0;k<C;k++)s+=O[k*P+p]*G[k*P+p];rem[p]=s;}
  for(int i=st[t];i<st[t+1];i++){
   const float*g=par+6*gi[i];const float*f=feat+C*gi[i];
   float mx=g[0],my=g[1],a=.5f*g[2],b=g[3],c=.5f*g[4],o=g[5]; float w[P],fg[P];float tm=0;
   float sx=0,sy=0,sxx=0,sxy=0,syy=0,so=0; float*gg=gi_grad+(size_t)i*(6+C);
   memset(fg,0,sizeof fg);
   for(int k=0;k<C;k++){float fk=f[k];
     #pragma omp simd
     for(int p=0;p<P;p++)fg[p]+=fk*G[k*P+p];}
   #pragma omp simd reduction(max:tm) reduction(+:sx,sy,sxx,sxy,syy,so)
   for(int p=0;p<P;p++){float dx=px[p]-mx,dy=py[p]-my; float e=expf(-(a*dx*dx+c*dy*dy+b*dx*dy));
     float al=o*e; al=al>.999f?.999f:al; al=al<1.f/255?0:al; w[p]=T[p]*al; float wf=w[p]*fg[p]; rem[p]-=wf;
     float dal=T[p]*fg[p]-rem[p]/(1-al); dal=al>0&&al<.999f?dal:0; so+=dal*e; float ds=-dal*al; sx+=ds*dx; sy+=ds*dy; sxx+=ds*dx*dx; sxy+=ds*dx*dy; syy+=ds*dy*dy;
     T[p]-=w[p]; tm=T[p]>tm?T[p]:tm;}
   gg[0]=-(2*a*sx+b*sy);gg[1]=-(2*c*sy+b*sx);gg[2]=.5f*sxx;gg[3]=sxy;gg[4]=.5f*syy;gg[5]=so;
   for(int k=0;k<C;k++){float s=0;
     #pragma omp simd reduction(+:s)
     for(int p=0;p<P;p++)s+=w[p]*G[k*P+p]; gg[6+k]=s;}
   if(tm<1e-4f)break;
  }
 }
}
